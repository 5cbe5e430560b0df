"""lgrasp reach: joints of an arm for grasps, against forward kinematics of another library."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yourdfpy
from support.shards import sample_hand, sample_on_table, sample_shard
from support.urdfs import ARM_HEIGHTS, arm, gripper

from lgrasp.dataset.conditions import parse_condition
from lgrasp.dataset.exports.selection import select_rows
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.run import run
from lgrasp.errors import HandError, OutputError, ShardError
from lgrasp.geometry.poses import compose, inverse, pose_from_matrix, pose_matrix
from lgrasp.grasp.records import HandRecord
from lgrasp.jobs.reach import ReachJob
from lgrasp.reach.arm import read_arm
from lgrasp.reach.placement import Placement
from lgrasp.reach.self_collision import ArmSolids, base_pieces
from lgrasp.reach.targets import CODES

IDLE = (
    '<link name="idle_{k}"/><joint name="joint_{k}" type="revolute"><parent link="base"/><child link="idle_{k}"/>'
    '<limit lower="-1" upper="2"/></joint>'
)
AT, MOUNT = "0.4,0.1,0.05:30", "0.01,0,0.02:10,20,30"
PLACED, MOUNTED = (Placement.model_validate(text).pose for text in (AT, MOUNT))


def arm_kinematics(path):
    """forward(q): transforms of all links (n, 4, 4) by name, for joints (n, J)."""
    model = yourdfpy.URDF.load(str(path), load_meshes=False)

    def forward(q):
        found = {name: [] for name in model.link_map}
        for row in q:
            model.update_cfg(row)
            for name, poses in found.items():
                poses.append(model.get_transform(name))
        return {name: np.array(poses) for name, poses in found.items()}

    return forward, np.array([[j.limit.lower, j.limit.upper] for j in model.actuated_joints])


def jaws(record: HandRecord, folder: Path, **how) -> HandRecord:
    """The hand is a gripper with two more joints, which move nothing."""
    more = "".join(IDLE.format(k=k) for k in "23")
    text = gripper(folder, **how).read_text().replace("</robot>", f"{more}</robot>")
    joints, links = ["l", "r", "joint_2", "joint_3"], ["base", "jaw_l", "jaw_r"]
    return replace(record, urdf=text, base_link="base", joint_names=joints, link_names=links)


@pytest.fixture
def job(tmp_path):
    """job(shard): reaches for the rows of a shard, which is written."""
    path = arm(tmp_path)

    def job(shard, **more):
        hand = jaws(shard.hand, tmp_path, kind="visual")
        write_shard(tmp_path / "in" / "toy-cup-00000.h5", replace(shard, hand=hand))
        given = {"arm": path, "at": AT, "mount": MOUNT, "device": "cpu", "workers": 1, "cache": Cache(tmp_path / "c")}
        return ReachJob.model_validate(given | {"shards": (tmp_path / "in",)} | more)

    return job


def with_poses(shard, pose):
    rows = replace(shard.grasps, object_pose=np.asarray(pose, "f4").reshape(-1, 1, 7))
    return replace(shard, grasps=rows)


def test_postures_put_the_hand_where_rows_say(job, tmp_path):
    """Poses that the arm takes in some posture are reached, others of its length are too far; limits are kept."""
    forward, limits = arm_kinematics(arm(tmp_path))
    rng = np.random.default_rng(3)
    n = 24
    hand = forward(rng.uniform(0.5 * limits[:, 0], 0.5 * limits[:, 1], (n, 7)))["flange"] @ pose_matrix(MOUNTED)
    hand[: n // 3, :3, 3] *= 4.0 / np.linalg.norm(hand[: n // 3, :3, 3], axis=1)[:, None]
    at = np.tile(PLACED, (n, 1))
    shard = with_poses(sample_shard(n), compose(inverse(pose_from_matrix(hand)), at))
    outcome = run(job(shard, tries=64))
    found = read_shard(outcome.paths[0]).grasps.physics
    ok = found["reach_ok"]
    assert ok.tolist() == [False] * (n // 3) + [True] * (n - n // 3)
    assert [CODES[code] for code in found["reach_code"]] == ["no_posture"] * (n // 3) + ["reached"] * (n - n // 3)
    q = found["reach_q_arm"]
    assert np.isnan(q[~ok]).all()
    assert ((q[ok] >= limits[:, 0] - 1e-6) & (q[ok] <= limits[:, 1] + 1e-6)).all()
    reached = forward(q[ok])["flange"] @ pose_matrix(MOUNTED)
    assert np.abs(reached[:, :3, 3] - hand[ok, :3, 3]).max() < 2e-4
    assert np.abs(reached[:, :3, :3] - hand[ok, :3, :3]).max() < 2e-3
    assert (found["reach_manipulability"][ok] > 0).all()
    np.testing.assert_allclose(found["reach_object_pose"], at, atol=1e-6)
    assert outcome.job.report(outcome)["results"] == [
        {"hand": "toy", "object": "cup.obj", "rows": n, **dict.fromkeys(CODES, 0), "reached": 16, "no_posture": 8}
    ]


def test_long_slides_bring_an_arm_near(job, tmp_path):
    """An arm on a gantry reaches the poses that it takes in some posture, however far its slides go."""
    gantry = "".join(
        f'<link name="{a}"/><joint name="{a}" type="prismatic"><parent link="{a}"/><child link="{b}"/>'
        f'<axis xyz="{axis}"/><limit lower="-1e5" upper="1e5"/></joint>'
        for a, b, axis in (("room", "bridge", "1 0 0"), ("bridge", "base", "0 1 0"))
    )
    path = arm(tmp_path, gantry)
    forward, limits = arm_kinematics(path)
    limits = np.clip(0.5 * limits, -1.0, 1.0)
    hand = forward(np.random.default_rng(4).uniform(*limits.T, (16, 9)))["flange"] @ pose_matrix(MOUNTED)
    shard = with_poses(sample_shard(16), compose(inverse(pose_from_matrix(hand)), np.tile(PLACED, (16, 1))))
    found = read_shard(run(job(shard, arm=path, tries=16)).paths[0]).grasps.physics
    assert found["reach_ok"].all()


def gaps(path, q):
    """Least distance of links that no joint joins at postures (n, 7), negative where they overlap, by Coal."""
    coal = pytest.importorskip("coal")
    links, parts = arm_kinematics(path)[0](q), []
    for i, z in enumerate([*ARM_HEIGHTS[1:], 0.05]):
        T = links[f"arm_{i}"].copy()
        T[:, :3, 3] += T[:, :3, 2] * (z or 0.05) / 2
        parts.append((coal.Cylinder(0.03, z or 0.05), [coal.Transform3s(x[:3, :3], x[:3, 3]) for x in T]))

    def gap(a, b, n):
        return coal.distance(a[0], a[1][n], b[0], b[1][n], coal.DistanceRequest(), coal.DistanceResult())

    return np.array([min(gap(a, b, n) for i, a in enumerate(parts) for b in parts[i + 2 :]) for n in range(len(q))])


def test_links_of_an_arm_are_apart(tmp_path):
    """As Coal finds; neighbours may touch. The base of a hand on the tip counts as a link."""
    path = arm(tmp_path, bend=3.0)
    _, limits = arm_kinematics(path)
    solids = ArmSolids(read_arm(path, None, np.eye(4)), [])
    upright, folded = np.zeros(7), np.array([0, 0, 0, 3.0, 0, 0, 0])
    assert solids.clear(np.stack([upright, folded])).tolist() == [True, False]
    q = np.random.default_rng(1).uniform(*limits.T, (300, 7))
    gap = gaps(path, q)
    sure = np.abs(gap) > 1e-3
    assert (solids.clear(q) == (gap > 0))[sure].all()
    assert 10 < (gap[sure] < 0).sum() < 290

    record = jaws(sample_hand(), tmp_path)
    bent = np.array([0, 0, 0, 0, 0, 2.4, 0])
    assert solids.clear(bent[None]).all()
    with_hand = ArmSolids(read_arm(path, None, pose_matrix(np.array([0.06, 0, 0, 1, 0, 0, 0]))), base_pieces(record))
    assert with_hand.clear(np.stack([upright, bent])).tolist() == [True, False]


def test_an_arm_never_folds_into_itself(job, tmp_path):
    """Poses of all postures: no joints are given that collide, and rows say where others are not found."""
    path = arm(tmp_path, bend=3.0)
    forward, limits = arm_kinematics(path)
    hand = forward(np.random.default_rng(2).uniform(*limits.T, (48, 7)))["flange"] @ pose_matrix(MOUNTED)
    shard = with_poses(sample_shard(48), compose(inverse(pose_from_matrix(hand)), np.tile(PLACED, (48, 1))))
    found = read_shard(run(job(shard, arm=path, tries=4)).paths[0]).grasps.physics
    codes = [CODES[code] for code in found["reach_code"]]
    assert codes.count("hits_itself") > 0, codes
    assert gaps(path, found["reach_q_arm"][found["reach_ok"]]).min() > -1e-4


def test_objects_on_a_table_are_reached_from_above_it(job, tmp_path):
    path = arm(tmp_path)
    forward, _ = arm_kinematics(path)
    shard = sample_on_table(32)
    pose = shard.grasps.object_pose[:, 0] * np.array([0.15, 0.15, 0.15, 1, 1, 1, 1])
    made = job(with_poses(shard, pose))
    rows = read_shard(run(made).paths[0]).grasps
    found, tables = rows.physics, shard.objects[0].tables
    assert tables is not None
    placed, up = pose_matrix(found["reach_object_pose"].astype(float)), tables[rows.table["pose"]]
    np.testing.assert_allclose((placed[:, :3, :3] @ up[:, :3, None])[..., 0], np.tile([0, 0, 1], (32, 1)), atol=1e-6)
    np.testing.assert_allclose(placed[:, :3, 3], np.column_stack([np.tile([0.4, 0.1], (32, 1)), 0.05 - up[:, 3]]))
    codes = np.bincount(found["reach_code"], minlength=len(CODES))
    assert (codes[[0, 3]] > 2).all(), codes
    ok = found["reach_ok"]
    described = read_arm(path, None, np.eye(4))
    for name, back in (("reach_q_arm", 0.0), ("reach_q_arm_approach", 0.15)):
        links = forward(found[name][ok])
        hand = links["flange"] @ pose_matrix(MOUNTED)
        hand[:, :3, 3] += back * (hand[:, :3, :3] @ rows.table["approach"][ok, :, None])[..., 0]
        assert np.abs(hand @ pose_matrix(pose[ok]) - placed[ok]).max() < 2e-3
        low = [links[link] @ np.append(point, 1) for link, points in described.points.items() for point in points]
        assert np.min(low, 0)[:, 2].min() > 0.05 - 1e-5


def test_a_shard_keeps_its_verdicts(job, tmp_path):
    shard = sample_shard(12)
    rows = with_poses(shard, shard.grasps.object_pose[:, 0] * np.array([0.1, 0.1, 0.1, 1, 1, 1, 1]))
    first = job(rows)
    assert run(first).made == 12
    again = run(first.changed())
    assert (again.made, again.present) == (0, 12)
    other = first.changed(at=first.at.model_copy(update={"position": (5.0, 0.0, 0.0)}))
    with pytest.raises(OutputError, match=r"verdicts of reach \(at.position: .* requested\); --overwrite"):
        run(other)
    reached = int(read_shard(again.paths[0]).grasps.physics["reach_ok"].sum())
    assert reached > 0
    where = [parse_condition("physics/reach_ok"), parse_condition("physics/reach_manipulability > 0")]
    assert select_rows(tmp_path / "in", where=where).rows == reached
    run(other, resume=False)
    with pytest.raises(ShardError, match="none satisfies physics/reach_ok"):
        select_rows(tmp_path / "in", where=where)


@pytest.mark.parametrize(
    ("more", "tip", "match"),
    [
        ("", "hand", "no link 'hand' that joints move; it has arm_0, "),
        ("", "base", "no link 'base'"),
        (
            '<link name="eye"/><joint name="e" type="fixed"><parent link="arm_6"/><child link="eye"/></joint>',
            None,
            "2 last links; name one with --tip: flange, eye",
        ),
        (
            '<link name="x"/><joint name="e" type="revolute"><parent link="arm_6"/><child link="x"/>'
            '<limit lower="0" upper="1"/><mimic joint="turn_0"/></joint>',
            "x",
            "joint 'e' follows 'turn_0'",
        ),
    ],
)
def test_arms_that_cannot_be_used(tmp_path, more, tip, match):
    with pytest.raises(HandError, match=match):
        read_arm(arm(tmp_path, more), tip, np.eye(4))


def test_an_arm_that_cannot_be_used_is_told_before_shards_are_read(job, tmp_path):
    asked = job(sample_shard(2), tip="hand")
    (tmp_path / "in" / "toy-cup-00000.h5").write_bytes(b"no shard")
    with pytest.raises(HandError, match="no link 'hand'"):
        run(asked)


def test_an_arm_without_its_meshes_is_its_origins(tmp_path):
    mesh = '<link name="x"><collision><geometry><mesh filename="gone.stl"/></geometry></collision></link>'
    joint = '<joint name="e" type="fixed"><parent link="arm_6"/><child link="x"/></joint>'
    found = read_arm(arm(tmp_path, mesh + joint), "flange", np.eye(4))
    assert "gone.stl" in found.note
    assert {len(points) for points in found.points.values()} == {1}

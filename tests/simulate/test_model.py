"""What MuJoCo is given: the kinematics of the URDF, the generator's solids, the inertia of the mesh."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import trimesh
from support.jaws import Jaws, mesh_record, shipped_hand
from support.kinematics import link_poses
from support.solids import YOU, no_cut, prism

from lgrasp.engine.cache import Cache
from lgrasp.errors import ShardError
from lgrasp.geometry.decompose import decompose
from lgrasp.geometry.poses import pose_matrix
from lgrasp.hand.distance import signed_distance
from lgrasp.simulate.assemble import bare_urdf
from lgrasp.simulate.model import Model, build_model
from lgrasp.simulate.mujoco_world import MujocoWorld
from lgrasp.simulate.protocol import PROTOCOLS
from lgrasp.simulate.run import group_rows, verdicts
from lgrasp.simulate.scene import Scene, hand_of_record, scene_of
from lgrasp.simulate.solid import object_of_record

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

FC = PROTOCOLS["fc"]
HANDS = ("allegro", "barrett", "dclaw", "leap", "schunk_svh", "shadow")


def open_allegro() -> tuple[Model, Any, np.ndarray]:
    """The model of the open Allegro, its state with the object far away, and its joints."""
    record, _, tree = shipped_hand("allegro")
    cube = object_of_record(mesh_record("cube", trimesh.creation.box([0.03] * 3)))
    q = tree.listed_values(tree.joint_open[None])[0]
    m = build_model(Scene(hand_of_record(record, no_cut), (cube,)), FC, q)
    data = mujoco.MjData(m.mujoco)
    data.qpos[m.object_address[0, 0]] = 10.0
    data.qpos[m.joint_address] = m.joint_matrix @ q + m.joint_offset
    return m, data, q


@pytest.mark.parametrize("name", HANDS)
def test_links_are_where_the_urdf_puts_them(name: str):
    """All joints: actuated, locked above and below the base link, and mimic ones, of the URDF or of hand.yaml."""
    record, path, tree = shipped_hand(name)
    cube = object_of_record(mesh_record("cube", trimesh.creation.box([0.03] * 3)))
    rng = np.random.default_rng(0)
    rows = tree.listed_values(rng.uniform(tree.joint_lower, tree.joint_upper).astype("f4")[None])
    model = build_model(Scene(hand_of_record(record, no_cut), (cube,)), FC, rows[0])
    data = mujoco.MjData(model.mujoco)
    data.qpos[model.joint_address] = model.joint_matrix @ rows[0] + model.joint_offset
    mujoco.mj_kinematics(model.mujoco, data)
    base = data.body(record.base_link)
    R_base = base.xmat.reshape(3, 3)
    wanted = link_poses(path, dict(zip(tree.listed_names, rows[0].tolist(), strict=True)), record.base_link)
    assert len(model.link_body) == len(wanted)
    for link, body in zip(record.link_names, model.link_body, strict=True):
        T = wanted[link]
        np.testing.assert_allclose(R_base.T @ (data.xpos[body] - base.xpos), T[:3, 3], atol=1e-6, err_msg=link)
        np.testing.assert_allclose(R_base.T @ data.xmat[body].reshape(3, 3), T[:3, :3], atol=1e-6, err_msg=link)


@pytest.mark.parametrize(
    ("change", "lacking"),
    [
        ({"joint_names": ["joint_3.0", "other"]}, "movable joint 'other'"),
        ({"base_link": "other"}, "link 'other'"),
        ({"link_names": ["base_link", "other"]}, "link 'other'"),
    ],
)
def test_columns_without_a_joint_are_refused(change: dict[str, Any], lacking: str):
    """They would stay where the simulator puts them."""
    record, _, _ = shipped_hand("allegro")
    with pytest.raises(ShardError, match=f"hand 'allegro': its URDF has no {lacking}"):
        hand_of_record(replace(record, **change), no_cut)


def test_drives_are_near_critically_damped(jaws: Jaws):
    """A drive that is let go returns within a tenth of a second and overshoots by no more than 5 %."""
    m, data, q = open_allegro()
    data.ctrl[:] = q[m.columns]
    data.ctrl[2] += 0.2
    trace = []
    for _ in range(100):
        mujoco.mj_step(m.mujoco, data)
        trace.append((data.qpos[m.joint_address[2]] - q[2]) / 0.2)
    assert max(trace) < 1.05
    assert min(trace[25:]) > 0.95


def test_inertia_is_that_of_the_mesh(jaws: Jaws):
    shard = jaws.shard()
    mesh = prism(YOU, 0.02)
    shard = replace(shard, objects=[mesh_record("you", mesh)])
    scene = scene_of(shard.hand, shard.objects, no_cut)
    model = build_model(scene, FC, shard.grasps.q[0])
    (body,) = model.object_body
    mesh.density = FC.mass / mesh.volume
    assert model.mujoco.body_mass[body] == pytest.approx(FC.mass)
    (group,) = group_rows(shard.grasps, scene.objects)
    world = MujocoWorld(model)
    world.begin(shard.grasps.q[0], group.rows.object_pose[0])
    base = world.data.body(model.base_body)
    T = pose_matrix(shard.grasps.object_pose[0, 0].astype(float))
    wanted = T[:3, :3] @ mesh.center_mass + T[:3, 3]
    np.testing.assert_allclose(base.xmat.reshape(3, 3).T @ (world.data.xipos[body] - base.xpos), wanted, atol=1e-7)
    np.testing.assert_allclose(
        np.sort(model.mujoco.body_inertia[body]), np.sort(mesh.principal_inertia_components), rtol=1e-4
    )


def test_a_dent_stays_open(tmp_path):
    """The slot of a U is no part of its pieces; where cutting fails the hull fills it, and that is said."""
    record = mesh_record("you", prism(YOU, 0.02))
    cut = object_of_record(record, lambda *a, **k: decompose(*a, **k, store=Cache(tmp_path)))
    assert len(cut.pieces) >= 3
    assert cut.excess < 1e-3
    assert not cut.notes
    hull = object_of_record(record, no_cut)
    assert len(hull.pieces) == 1
    assert hull.excess == pytest.approx(0.006, abs=3e-4)  # half the slot's width
    assert hull.notes == ("the convex hull stands for the mesh, its dents are filled (made up)",)
    assert hull.volume == cut.volume == pytest.approx(prism(YOU, 0.02).volume, rel=1e-5)


def test_pieces_of_bodies_that_overlap_stay_in_them():
    """What is inside one body is inside, however far from the other's surface."""
    bars = [trimesh.creation.box(sides) for sides in ((0.12, 0.03, 0.03), (0.03, 0.12, 0.04))]
    record = mesh_record("cross", trimesh.util.concatenate(bars))
    found = object_of_record(record, lambda *_, **__: [bar.vertices for bar in bars])
    assert found.excess < 1e-6
    assert found.volume == pytest.approx(trimesh.boolean.union(bars).volume, rel=1e-5)


def test_pieces_follow_the_mesh_with_few_corners():
    """A smooth ball is a piece of some hundred corners within a fifth of a millimetre, and weighs as the mesh."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.03)
    solid = object_of_record(mesh_record("ball", ball), no_cut)
    (piece,) = solid.pieces
    assert len(piece) < len(ball.vertices) / 2
    hull = trimesh.convex.convex_hull(piece)
    assert signed_distance(hull, np.asarray(ball.vertices)).max() < 2.1e-4
    assert hull.volume > 0.98 * ball.volume
    assert solid.volume == pytest.approx(ball.volume, rel=1e-5)


def test_a_mesh_that_is_not_closed_is_said():
    cube = trimesh.creation.box([0.03] * 3)
    cube.update_faces(np.arange(len(cube.faces)) > 0)
    solid = object_of_record(mesh_record("open", cube), no_cut)
    assert solid.volume == pytest.approx(0.03**3)
    assert any("not closed" in note for note in solid.notes)


def test_holes_are_filled_before_a_mesh_is_cut():
    """As a shell of walls it would take minutes."""
    you, given = prism(YOU, 0.02), []
    you.update_faces(np.arange(len(you.faces)) > 0)

    def cut(vertices: np.ndarray, faces: np.ndarray, **_: Any) -> list[np.ndarray]:
        given.append(trimesh.Trimesh(vertices, faces))
        return [vertices]

    object_of_record(mesh_record("you", you), cut)
    assert given[0].is_watertight
    assert given[0].volume == pytest.approx(prism(YOU, 0.02).volume, rel=1e-5)


@pytest.mark.parametrize(("kind", "count"), [("fixed", 1), ("revolute", 1), ("prismatic", 1), ("prismatic", 3)])
def test_what_carries_the_base_does_not_matter(jaws: Jaws, kind: str, count: int):
    """The base on a turned mount, or on joints of which each follows the one before and the first is held somewhere:
    poses and pulls are in the base's frame."""
    plain = jaws.shard(0.004)
    limit = '<limit lower="-1" upper="1" effort="1" velocity="1"/>' if kind != "fixed" else ""
    urdf = plain.hand.urdf
    for joint, before, link in [("w", "", "base"), ("v", "w", "m w"), ("u", "v", "m v")][:count]:
        mimic = f'<mimic joint="{before}" multiplier="0.5" offset="0.1"/>' if before else ""
        mount = (
            f'<link name="m {joint}"/><joint name="{joint}" type="{kind}"><parent link="m {joint}"/>'
            f'<child link="{link}"/><origin xyz="0.1 -0.2 0.3" rpy="0.3 -1.2 2"/><axis xyz="0 0.6 0.8"/>{limit}{mimic}'
            "</joint></robot>"
        )
        urdf = urdf.replace("</robot>", mount)
    names = ("l", "r") if kind == "fixed" else ("l", "r", "w")
    rows = plain.grasps
    if kind != "fixed":
        wide = {n: np.hstack([getattr(rows, n), [[np.float32(0.5)]]]) for n in ("q", "q_pregrasp", "q_squeeze")}
        rows = replace(rows, **wide)
    carried = replace(plain, hand=replace(plain.hand, urdf=urdf, joint_names=names), grasps=rows)
    a, b = (verdicts(scene_of(s.hand, s.objects), s.grasps, FC, all_directions=True) for s in (plain, carried))
    assert a["fc_holds"].all()
    for name, values in a.items():
        np.testing.assert_allclose(values, b[name], atol=1e-5, err_msg=name)


def test_neighbours_and_sockets_do_not_collide():
    """At random postures of the Allegro no pair of joined links is in contact, nor one with the welded base."""
    m, data, _ = open_allegro()
    mujoco.mj_forward(m.mujoco, data)
    assert data.ncon == 0
    assert (m.mujoco.body_weldid[m.mujoco.geom_bodyid] == 0).any()


def test_a_second_inertia_of_a_link_is_left_out():
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    text = f'<robot name="r"><link name="a">{inertial}{inertial.replace("1", "2")}</link></robot>'
    bare = bare_urdf(text, {})
    assert bare.count("<mass") == 1
    assert '<mass value="1"/>' in bare

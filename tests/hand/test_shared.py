"""Shared joints: groups that stand by themselves once a setting is chosen, with the kinematics of the whole URDF."""

import numpy as np
import pytest
import yourdfpy
from support.hands import minimal_spec

from lgrasp.errors import HandError
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.build import build_hand
from lgrasp.hand.find import find_hand
from lgrasp.hand.spec import HandSpec
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf

SHIPPED = ["barrett", "schunk_svh"]


@pytest.mark.parametrize("name", SHIPPED)
def test_every_link_is_where_the_urdf_puts_it(name):
    source = find_hand(name)
    model = build_hand(source.urdf, source.spec, pieces_only=True)
    tree = model.tree
    rng = np.random.default_rng(0)
    q = rng.uniform(tree.joint_lower, tree.joint_upper, (10, model.dofs)).astype(np.float32)
    poses = body_poses(upload_hand(model, "cpu"), q)
    urdf = yourdfpy.URDF.load(str(source.urdf), load_meshes=False, build_collision_scene_graph=False)
    for row in range(len(q)):
        urdf.update_cfg(dict(zip(tree.joint_names, q[row].astype(float), strict=True)))
        for link, body, T in zip(tree.link_names, tree.link_body, tree.T_body_link, strict=True):
            wanted = urdf.get_transform(link, tree.base_link)
            p = poses[row, body, :3] + _rotate(poses[row, body, 3:], T[:3, 3])
            np.testing.assert_allclose(p, wanted[:3, 3], atol=2e-6, err_msg=link)


def _rotate(quaternion: np.ndarray, v: np.ndarray) -> np.ndarray:
    x, w = quaternion[:3], quaternion[3]
    return v + 2 * np.cross(x, np.cross(x, v) + w * v)


@pytest.mark.parametrize("name", SHIPPED)
def test_groups_share_nothing_but_the_shared_joints(name):
    source = find_hand(name)
    tree = build_tree(read_urdf(source.urdf), source.spec)
    own = [tree.dof_index[f : f + n] for f, n in zip(tree.dof_first, tree.dof_free, strict=False)]
    everything = np.concatenate(own)
    assert len(set(everything)) == len(everything)
    free = {tree.joint_names[k] for k in everything}
    assert free == set(tree.joint_names) - set(tree.shared_names)
    for g in range(tree.groups):
        rest = tree.dof_index[tree.dof_first[g] + tree.dof_free[g] : tree.dof_first[g + 1]]
        assert {tree.joint_names[k] for k in rest} <= set(tree.shared_names)


def test_fingers_behind_a_free_joint_stay_together():
    """Ring and little finger ride on the palm's fold: with the opposition free they move with the thumb."""
    source = find_hand("schunk_svh")
    spec = source.spec.model_copy(update={"shared": {"right_hand_Finger_Spread": (0.0, 0.5)}})
    tree = build_tree(read_urdf(source.urdf), spec)
    assert tree.groups == 3
    assert len(tree.settings) == 2
    groups = {
        frozenset(tree.joint_names[k] for k in tree.dof_index[f : f + n])
        for f, n in zip(tree.dof_first, tree.dof_free, strict=False)
    }
    thumb = {"Thumb_Opposition", "Thumb_Flexion", "Ring_Finger", "Pinky"}
    assert frozenset(f"right_hand_{n}" for n in thumb) in groups


def test_solids_are_not_doubled():
    """A link on a joint that several groups share has its solid once."""
    source = find_hand("schunk_svh")
    free = build_hand(source.urdf, source.spec, pieces_only=True)
    held = source.spec.model_copy(
        update={"shared": {}, "locked": {n: v[0] for n, v in source.spec.shared.items()}, "palm": source.spec.palm}
    )
    assert len(build_hand(source.urdf, held, pieces_only=True).piece_link) == len(free.piece_link)


def spread_hand(**changes):
    source = find_hand("barrett")
    return read_urdf(source.urdf), source.spec.model_copy(update=changes)


@pytest.mark.parametrize(
    ("shared", "message"),
    [
        ({"elbow": (0.0,)}, "'elbow' is not a joint"),
        ({"finger_2_prox_joint": (0.1,)}, "'finger_2_prox_joint' is not a joint .* that moves by itself"),
        ({"finger_1_prox_joint": ()}, "has no values"),
        ({"finger_1_prox_joint": (0.5,)}, r"= 0.5 is outside its limits \[-3.14, 0\]"),
        ({"finger_1_prox_joint": tuple(np.linspace(-3, 0, 33))}, "33 settings, at most 32"),
    ],
)
def test_bad_shared_joints(shared, message):
    urdf, spec = spread_hand(shared=shared)
    with pytest.raises(HandError, match=message):
        build_tree(urdf, spec)


@pytest.fixture
def couples(tmp_path):
    """Rules and joint tree of a hand with joints j, k, m, and l that mimics k, once hand.yaml says more."""
    box = '<collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision>'
    links = "".join(f'<link name="{n}">{box}</link>' for n in "abcde")
    text = f"""<robot name="r">{links}
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="0" upper="1"/></joint>
      <joint name="k" type="revolute"><parent link="a"/><child link="c"/><limit lower="-1" upper="1"/></joint>
      <joint name="l" type="revolute"><parent link="a"/><child link="d"/><limit lower="-2" upper="2"/>
        <mimic joint="k" multiplier="2"/></joint>
      <joint name="m" type="revolute"><parent link="a"/><child link="e"/><limit lower="-3" upper="3"/></joint>
      </robot>"""
    path = tmp_path / "r.urdf"
    path.write_text(text)

    def build(**more):
        return build_tree(read_urdf(path), HandSpec.model_validate(minimal_spec("r", ["b"]).model_dump() | more))

    return build


def test_a_coupling_of_the_rules_counts_like_one_of_the_urdf(couples):
    assert couples().groups == 3
    tree = couples(mimic={"k": {"joint": "j", "multiplier": -0.5, "offset": 0.1}})
    assert tree.groups == 2
    assert tree.joint_names == ("j", "m")
    assert sorted(tree.joint_mult) == [-1.0, -0.5, 1.0, 1.0]


def test_joints_that_only_the_rules_couple_are_listed(couples):
    """Those that the URDF couples are not: whoever reads the URDF moves them along."""
    tree = couples(mimic={"k": {"joint": "j", "multiplier": -0.5, "offset": 0.1}})
    assert tree.listed_names == ("j", "m", "k")
    np.testing.assert_allclose(tree.listed_limits, [[0, 1], [-3, 3], [-1, 1]])
    q = np.array([[0.0, 0.7], [0.6, 0.7]])
    np.testing.assert_allclose(tree.listed_values(q), [[0, 0.7, 0.1], [0.6, 0.7, -0.2]], atol=1e-7)
    assert couples().listed_names == ("j", "k", "m")


def test_couplings_to_a_locked_joint_are_locked(couples):
    coupling = {"joint": "l", "multiplier": 0.5, "offset": 0.1}
    tree = couples(locked={"k": 0.4}, mimic={"m": coupling})
    assert tree.listed_names == ("j", "k", "m")
    assert tree.locked_names == ("k", "m")
    np.testing.assert_allclose(tree.listed_limits[1:], [[-1, 1], [-3, 3]])
    np.testing.assert_allclose(tree.listed_values(np.array([[0.3]])), [[0.3, 0.4, 0.5]], atol=1e-7)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"mimic": {"k": {"joint": "k"}}}, "mimics itself"),
        ({"mimic": {"k": {"joint": "x"}}}, "mimic names 'x', not a movable joint"),
        ({"mimic": {"l": {"joint": "j"}}}, "mimic couples 'l' to 1 x 'j', but .* couples it to 2 x 'k'"),
        ({"locked": {"l": 0.1}}, "'l' is locked but follows joint 'k'; lock that one"),
        (
            {"locked": {"k": 0.9}, "mimic": {"m": {"joint": "l", "multiplier": -2.0}}},
            r"joint that follows a locked one, 'm' = -3.6 is outside its limits \[-3, 3\]",
        ),
    ],
)
def test_bad_couplings(couples, more, message):
    with pytest.raises(HandError, match=message):
        couples(**more)

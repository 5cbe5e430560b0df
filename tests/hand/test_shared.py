"""Shared joints: groups that stand by themselves once a setting is chosen, with the kinematics of the whole URDF."""

import numpy as np
import pytest
import yourdfpy
from reference.hands import minimal_spec

from lgrasp.errors import HandError
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.find import find_hand
from lgrasp.hand.model import build_hand
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf

SHIPPED = ["barrett", "schunk_svh"]


@pytest.mark.parametrize("name", SHIPPED)
def test_every_link_is_where_the_urdf_puts_it(name):
    source = find_hand(name)
    model = build_hand(source.urdf, source.spec)
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
    free = build_hand(source.urdf, source.spec)
    held = source.spec.model_copy(
        update={"shared": {}, "locked": {n: v[0] for n, v in source.spec.shared.items()}, "palm": source.spec.palm}
    )
    assert len(build_hand(source.urdf, held).piece_link) == len(free.piece_link)


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


def test_a_coupling_of_the_rules_counts_like_one_of_the_urdf(tmp_path):
    box = '<collision><geometry><box size="0.01 0.01 0.05"/></geometry></collision>'
    links = "".join(f'<link name="{n}">{box}</link>' for n in "abc")
    text = f"""<robot name="r">{links}
      <joint name="j" type="revolute"><parent link="a"/><child link="b"/><limit lower="0" upper="1"/></joint>
      <joint name="k" type="revolute"><parent link="a"/><child link="c"/><limit lower="-1" upper="0"/></joint>
      </robot>"""
    path = tmp_path / "r.urdf"
    path.write_text(text)
    spec = minimal_spec("r", ["b"])
    assert build_tree(read_urdf(path), spec).groups == 2
    from lgrasp.hand.spec import HandSpec

    coupled = HandSpec.model_validate(spec.model_dump() | {"mimic": {"k": {"joint": "j", "multiplier": -0.5}}})
    tree = build_tree(read_urdf(path), coupled)
    assert tree.joint_names == ("j",)
    assert sorted(tree.joint_mult) == [-0.5, 1.0]
    bad = HandSpec.model_validate(spec.model_dump() | {"mimic": {"k": {"joint": "k"}}})
    with pytest.raises(HandError, match="mimics itself"):
        build_tree(read_urdf(path), bad)

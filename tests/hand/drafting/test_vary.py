"""Variants of hands: what changes, by how much, and what stays."""

import numpy as np
import pytest
import trimesh
import yaml
from support.places import ROOT
from support.urdfs import fingers

from lgrasp.errors import HandError
from lgrasp.hand.drafting.import_urdf import import_urdf
from lgrasp.hand.drafting.vary import write_variant
from lgrasp.hand.find import HandSource, find_hand
from lgrasp.hand.links import link_poses
from lgrasp.hand.tree import build_tree
from lgrasp.hand.urdf import read_urdf

HANDS = ("allegro", "barrett", "dclaw", "leap", "schunk_svh", "shadow")


def tree_of(source):
    return build_tree(read_urdf(source.urdf), source.spec)


@pytest.fixture
def vary(tmp_path):
    """vary(hand, kind, factor): the hand and its variant."""

    def vary(name, kind, factor):
        source = find_hand(str(name))
        folder = write_variant(source, kind, factor, f"{source.name}-new", tmp_path / kind / f"{factor:g}")
        return source, find_hand(str(folder))

    return vary


@pytest.mark.parametrize("name", HANDS)
def test_ranges_about_their_middles(vary, name):
    source, varied = vary(name, "joint_limit", 0.5)
    assert varied.name == f"{name}-new"
    old, new = tree_of(source), tree_of(varied)
    assert old.joint_names == new.joint_names
    np.testing.assert_allclose(new.joint_upper + new.joint_lower, old.joint_upper + old.joint_lower, atol=1e-6)
    np.testing.assert_allclose(new.joint_upper - new.joint_lower, 0.5 * (old.joint_upper - old.joint_lower), atol=1e-6)
    assert (new.joint_open >= new.joint_lower).all()
    assert (new.joint_open <= new.joint_upper).all()


@pytest.mark.parametrize("name", HANDS)
def test_fingers_of_another_size(vary, name):
    """At every posture a moving link is where it was, as seen from its finger's mount, times the factor."""
    source, varied = vary(name, "link_scale", 1.25)
    old, new = read_urdf(source.urdf), read_urdf(varied.urdf)
    tree = tree_of(source)
    q = np.random.default_rng(0).uniform(tree.joint_lower, tree.joint_upper, (5, len(tree.joint_names)))
    values = dict(zip(tree.listed_names, tree.listed_values(q).T, strict=True))
    before, after = (link_poses(urdf, tree.base_link, values) for urdf in (old, new))
    mounts = {}
    for joint in old.joints:
        if joint.child in tree.link_names and tree.body_of(joint.child) > 0:
            first = joint.parent not in tree.link_names or tree.body_of(joint.parent) == 0
            mounts[joint.child] = before[joint.child][:, :3, 3] if first else mounts[joint.parent]
            want = mounts[joint.child] + 1.25 * (before[joint.child][:, :3, 3] - mounts[joint.child])
            np.testing.assert_allclose(after[joint.child][:, :3, 3], want, atol=1e-9)
            for a, b in zip(old.links[joint.child], new.links[joint.child], strict=True):
                np.testing.assert_allclose(b.size, 1.25 * np.array(a.size))
        elif joint.child in tree.link_names:
            np.testing.assert_allclose(after[joint.child], before[joint.child])
    assert mounts


def test_mounts_apart(vary):
    source, varied = vary("leap", "finger_spacing", 1.5)
    old, new = tree_of(source), tree_of(varied)
    roots = old.joint_parent < 0
    at, now = old.T_parent_joint[roots], new.T_parent_joint[roots]
    middle = at[:, :3, 3].mean(0)
    np.testing.assert_allclose(now[:, :3, 3] - middle, 1.5 * (at[:, :3, 3] - middle), atol=1e-9)
    np.testing.assert_allclose(now[:, :3, :3], at[:, :3, :3], atol=1e-9)
    np.testing.assert_allclose(new.T_parent_joint[~roots], old.T_parent_joint[~roots])


def test_meshes_come_along(vary, tmp_path):
    trimesh.creation.box((0.015, 0.015, 0.05)).export(tmp_path / "bar.stl")
    tip = '<geometry><mesh filename="bar.stl"/></geometry>'
    made = import_urdf(fingers(tmp_path, 2, tip=tip), name="bars", out=tmp_path / "bars")
    _, varied = vary(made.folder, "link_scale", 2.0)
    files = read_urdf(varied.urdf).mesh_files
    assert files
    assert all(file.is_relative_to(varied.urdf.parent) for file in files.values())
    (shape,) = read_urdf(varied.urdf).links["b0"]
    assert shape.size == (2.0, 2.0, 2.0)


def test_locked_joints_stay_inside_their_limits(vary, tmp_path):
    rules = yaml.safe_load((ROOT / "hands" / "allegro" / "hand.yaml").read_text())
    rules |= {"locked": {"joint_0.0": 0.4}, "opposition_spaces": {}}
    (tmp_path / "hand.yaml").write_text(yaml.safe_dump(rules))
    (tmp_path / "hand.urdf").write_bytes((ROOT / "hands" / "allegro" / "hand.urdf").read_bytes())
    source, varied = vary(tmp_path, "joint_limit", 0.5)
    held = tree_of(varied)
    assert held.locked_values[0] == pytest.approx(0.5 * tree_of(source).locked_limits[0, 1])
    assert held.locked_values[0] < 0.4


def test_joints_that_slide_along_a_finger_are_refused(tmp_path):
    """How far they go is no length of a part."""
    text = fingers(tmp_path, 2).read_text()
    turns = '<joint name="k0" type="revolute">'
    assert turns in text
    (tmp_path / "slides.urdf").write_text(text.replace(turns, turns.replace("revolute", "prismatic")))
    made = import_urdf(tmp_path / "slides.urdf", name="slides", out=tmp_path / "slides")
    source = find_hand(str(made.folder))
    with pytest.raises(HandError, match=r"cannot be varied by link_scale: joint 'k0' slides along a part"):
        write_variant(source, "link_scale", 2.0, "new", tmp_path / "new")
    write_variant(source, "joint_limit", 0.5, "new", tmp_path / "new")


def test_what_cannot_be_leaves_nothing(tmp_path):
    (tmp_path / "hand.urdf").write_text("<robo/>")
    spec = find_hand("allegro").spec
    with pytest.raises(HandError):
        write_variant(HandSource("odd", tmp_path / "hand.urdf", spec), "link_scale", 2.0, "new", tmp_path / "new")
    assert not (tmp_path / "new").exists()

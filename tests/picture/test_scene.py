"""The scene of a row: links, objects and contacts meet where the row says."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from support.jaws import EDGE, HEIGHT, jaw_rows, jaw_shard

from lgrasp.errors import ShardError
from lgrasp.picture.draw import draw_scene
from lgrasp.picture.scene import HandShape, scene_of_row


@pytest.fixture(scope="module")
def shard(tmp_path_factory):
    return jaw_shard(tmp_path_factory.mktemp("jaws"), jaw_rows(press=0.002, opening=0.01, count=2))


@pytest.fixture(scope="module")
def hand(shard):
    return HandShape.of_record(shard.hand)


def gap(scene, stage):
    """Distances [m] of the contacts from the nearest jaw."""
    links = scene.hand.placed(scene.steps[-1].stages[stage])
    whole = trimesh.util.concatenate([links["jaw_l"], links["jaw_r"]])
    return trimesh.proximity.closest_point(whole, scene.contacts.points)[1]


def test_contacts_lie_on_hand_and_object(shard, hand):
    scene = scene_of_row(hand, shard.objects, shard.grasps, 1)
    (cube,) = scene.objects
    half = np.full(3, EDGE / 2)
    np.testing.assert_allclose(cube.placed.bounds, np.add([-half, half], [0, 0, HEIGHT]), atol=1e-7)
    np.testing.assert_allclose(trimesh.proximity.closest_point(cube.placed, scene.contacts.points)[1], 0, atol=1e-7)
    np.testing.assert_allclose(gap(scene, "grasp"), 0, atol=1e-7)
    np.testing.assert_allclose(gap(scene, "pregrasp"), 0.01, atol=1e-7)
    np.testing.assert_allclose(scene.contacts.forces, -0.5 * scene.contacts.normals, atol=1e-7)


def test_contacts_turn_with_the_object(shard, hand):
    half = np.sqrt(0.5)
    pose = np.array([[[0, 0, HEIGHT, half, 0, 0, half]]] * 2, "f4")  # a quarter turn about z
    scene = scene_of_row(hand, shard.objects, replace(shard.grasps, object_pose=pose), 0)
    np.testing.assert_allclose(scene.contacts.points, [[0, EDGE / 2, HEIGHT], [0, -EDGE / 2, HEIGHT]], atol=1e-7)
    np.testing.assert_allclose(scene.contacts.normals, [[0, 1, 0], [0, -1, 0]], atol=1e-7)


def test_the_table_touches_the_object(shard, hand):
    cube = replace(shard.objects[0], tables=np.array([[0, 0, 1, -EDGE / 2, 1], [0, 1, 0, -EDGE / 2, 0]], "f4"))
    rows = replace(shard.grasps, table={"pose": np.ones(2, "i4")})
    table = scene_of_row(hand, [cube], rows, 0).table
    assert table is not None
    np.testing.assert_allclose(table[:3, 2:].T, [[0, 1, 0], [0, -EDGE / 2, HEIGHT]], atol=1e-7)
    assert scene_of_row(hand, shard.objects, shard.grasps, 0).table is None


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"object_index": np.full((2, 1), 7, "i4")}, "object_index is 7"),
        ({"q": np.full((2, 2), np.nan, "f4")}, "not finite"),
        ({"object_pose": np.zeros((2, 1, 7), "f4")}, "not finite"),
    ],
)
def test_rows_that_cannot_be_shown_say_why(shard, hand, change, message):
    with pytest.raises(ShardError, match=message), np.errstate(invalid="ignore"):
        scene_of_row(hand, shard.objects, replace(shard.grasps, **change), 0)


def test_a_hand_whose_urdf_lacks_a_joint_is_named(shard):
    with pytest.raises(ShardError, match="no movable joint 'elbow'"):
        HandShape.of_record(replace(shard.hand, joint_names=("l", "elbow")))


def test_a_table_is_level_below_the_object(shard, hand):
    turn = np.array([[0, 0, 1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1.0]])  # its x axis is up
    scene = scene_of_row(hand, shard.objects, shard.grasps, 0)
    middle = scene.objects[0].placed.bounds.mean(0)
    table = turn.copy()
    table[:3, 3] = middle - EDGE / 2 * turn[:3, 2]
    size = 64
    (picture,) = draw_scene(replace(scene, table=table), size, [1], 0)
    (without,) = draw_scene(scene, size, [1], 0)
    grey = (np.ptp(picture.astype(int), axis=-1) < 12) & (picture.max(-1) < 250)
    assert grey[-8:].mean() > 0.5, "no table at the bottom of the picture"
    assert not grey[:8].any(), "it is not level"
    assert (without[[0, -1]] == 255).all()

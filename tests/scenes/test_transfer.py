"""Grasps in a scene: poses by closed formula, collisions against plain geometry in NumPy."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from lgrasp.engine.inputs import Inputs
from lgrasp.geometry.poses import device_matrix, pose_matrix
from lgrasp.hand.arrays import body_poses
from lgrasp.object.arrays import upload_object
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.scenes.make import find_collisions, hand_poses

SMALL = ObjectParams(contact_count=256, obstacle_count=2048, sdf_cells=64**3, sdf_min_cell=0.001)
LIMIT = 0.001


def random_poses(rng: np.random.Generator, n: int, spread: float = 0.1) -> np.ndarray:
    turn = rng.normal(size=(n, 4))
    turn /= np.linalg.norm(turn, axis=1)[:, None]
    turn[turn[:, 0] < 0] *= -1
    return np.hstack([rng.uniform(-spread, spread, (n, 3)), turn])


@pytest.fixture(scope="module")
def ball(tmp_path_factory: pytest.TempPathFactory):
    """A ball of radius 40 mm whose own frame is off its centre."""
    path: Path = tmp_path_factory.mktemp("ball") / "ball.obj"
    trimesh.creation.icosphere(subdivisions=4, radius=0.04).apply_translation([0.1, 0.0, 0.0]).export(path)
    return upload_object(preprocess_object(path, params=SMALL), "cpu")


def test_the_object_keeps_its_place_in_the_hand():
    rng = np.random.default_rng(0)
    scene_object, hand_object = random_poses(rng, 1)[0], random_poses(rng, 20)
    found = pose_matrix(hand_poses(scene_object, hand_object)) @ pose_matrix(hand_object)
    np.testing.assert_allclose(found, np.broadcast_to(pose_matrix(scene_object), found.shape), atol=1e-12)


def test_depth_in_the_table_is_that_of_the_lowest_point(inputs: Inputs, ball):
    rng, hand = np.random.default_rng(1), inputs.hand
    tree, model = hand.model.tree, hand.model
    q = rng.uniform(tree.joint_lower, tree.joint_upper, (30, hand.model.dofs)).astype(np.float32)
    before = np.roll(q, 1, axis=0)
    pose = random_poses(rng, 30)
    pose[:, 2] += 0.05
    far = np.array([[5.0, 0, 0, 1, 0, 0, 0]])
    found = find_collisions(hand, [ball], far, -1, pose, before, q, LIMIT)
    assert (found.objects == 0).all()
    body = np.repeat(model.piece_body, np.diff(model.vertex_first))
    radius = np.repeat(model.piece_radius, np.diff(model.vertex_first))
    for column, posture in enumerate((before, q)):
        T = body_poses(hand, posture)
        for row in range(30):
            at = pose_matrix(pose[row]) @ device_matrix(T[row])
            points = np.einsum("vab,vb->va", at[body, :3, :3], model.vertices) + at[body, :3, 3]
            expected = max(0.0, -float((points[:, 2] - radius).min()))
            np.testing.assert_allclose(found.table[row, column], expected, atol=2e-6)


def test_depth_in_other_objects(inputs: Inputs, ball):
    """A ball against samples of the hand's surface: deeper than the limit, or apart, as the distances say."""
    rng, hand = np.random.default_rng(2), inputs.hand
    model, n = hand.model, 60
    q = np.broadcast_to(model.tree.joint_open, (n, model.dofs)).astype(np.float32)
    pose = np.tile([0.0, 0, 1.0, 1, 0, 0, 0], (n, 1))
    where = random_poses(rng, n, 0.2)
    where[:, 2] += 1.0
    samples = np.repeat(np.arange(len(model.cluster_first) - 1), np.diff(model.cluster_first) * 32)
    T = pose_matrix(pose[0]) @ device_matrix(body_poses(hand, q[:1])[0])
    surface = np.einsum("vab,vb->va", T[samples, :3, :3], model.samples) + T[samples, :3, 3]
    hits = misses = 0
    for row in range(n):
        centre = pose_matrix(where[row]) @ [0.1, 0, 0, 1]
        deep = 0.04 - np.linalg.norm(surface - centre[:3], axis=1).min()
        found = find_collisions(hand, [ball, ball], where[[row, row]], 1, pose[:1], q[:1], q[:1], LIMIT)
        assert found.table.max() == 0
        if deep > LIMIT + 5e-4:
            assert (found.objects > LIMIT).all(), (row, deep)
            hits += 1
        elif deep < -3e-3:
            assert (found.objects <= LIMIT).all(), (row, deep)
            misses += 1
        own = find_collisions(hand, [ball], where[[row]], 0, pose[:1], q[:1], q[:1], LIMIT)
        assert (own.objects == 0).all()  # what is grasped does not count
    assert min(hits, misses) > 5


def test_no_grasps(inputs: Inputs, ball):
    none = np.zeros((0, inputs.hand.model.dofs), np.float32)
    found = find_collisions(
        inputs.hand, [ball], np.array([[0.0, 0, 0, 1, 0, 0, 0]]), 0, np.zeros((0, 7)), none, none, 0.0
    )
    assert found.table.shape == found.objects.shape == (0, 2)

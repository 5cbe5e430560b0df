"""Starts of a plan: palms that face the surface, weights, farthest points."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from lgrasp.engine.cache import Cache
from lgrasp.errors import HandError
from lgrasp.hand.arrays import upload_hand
from lgrasp.hand.contact_surface import contact_surface, palm_axis
from lgrasp.jobs.shard_inputs import named_hand
from lgrasp.planning.params import PlanParams
from lgrasp.planning.planner import Planner
from lgrasp.planning.starts import start_poses, tilted
from lgrasp.refine.params import DISTAL, OTHER
from lgrasp.refine.surface import farthest_points, hand_surface


def test_palm_faces_the_point_from_the_stand_off(inputs):
    model, obj = inputs.hand.model, inputs.object.model
    points, normals = obj.contact_points[:40].astype(float), obj.contact_normals[:40].astype(float)
    pose = start_poses(model, points, normals, np.linspace(0, 6, 40), 0.13)
    R, t = Rotation.from_quat(pose[:, 3:]).as_matrix(), pose[:, :3]
    centre, facing = palm_axis(model)
    np.testing.assert_allclose(R @ facing, -normals, atol=1e-6)
    palm = np.einsum("nij,j->ni", R, centre) + t
    np.testing.assert_allclose(np.cross(palm - points, normals), 0, atol=1e-6)  # the line meets the point
    np.testing.assert_allclose(((t - points) * normals).sum(1), 0.13, atol=1e-6)


def test_farthest_points_begin_alike_and_spread():
    points = np.random.default_rng(0).normal(size=(300, 3))
    few, many = farthest_points(points, 10), farthest_points(points, 40)
    assert list(few) == list(many[:10])
    assert len(set(many)) == 40
    gaps = np.linalg.norm(points[few][:, None] - points[few][None], axis=2) + 9 * np.eye(10)
    assert gaps.min() > 1.0


def test_palmar_points_weigh_as_told(inputs):
    model = inputs.hand.model
    surface = hand_surface(model)
    assert set(np.unique(surface.weight)) == {0.0, OTHER, DISTAL}
    tips = {int(b) for b in surface.body[(surface.weight == DISTAL).any(1)]}
    assert len(tips) == model.groups  # one last link a finger
    pulled = surface.points[surface.weight > 0]
    gap = np.linalg.norm(pulled[:, None] - contact_surface(model).points[None], axis=2).min(1)
    assert gap.max() < 1e-6


def test_tilted_directions_lean_by_their_angle_to_all_sides():
    normals = np.random.default_rng(0).normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    angle, azimuth = np.linspace(0, np.pi / 2, 400), np.arange(400) * 2.4
    back = tilted(normals, angle, azimuth)
    np.testing.assert_allclose(np.linalg.norm(back, axis=1), 1)
    np.testing.assert_allclose(np.arccos(np.clip((back * normals).sum(1), -1, 1)), angle, atol=1e-6)
    around = tilted(np.tile([0.0, 0, 1], (8, 1)), np.full(8, np.pi / 2), np.arange(8) * np.pi / 4)
    np.testing.assert_allclose(around.sum(0), 0, atol=1e-12)


def test_a_hand_without_a_palm_faces_its_box(cache_root, load):
    source, dclaw = named_hand(Cache(cache_root, pytest.fail), "dclaw")
    centre, facing = palm_axis(dclaw)
    np.testing.assert_allclose(facing, [1, 0, 0], atol=0.01)  # fingers along +x
    assert np.linalg.norm(centre) < 0.02
    ball = load("sphere").object.model
    assert source.spec.stand_off
    planner = Planner(upload_hand(dclaw, "cpu"), ball, source.spec.stand_off, PlanParams(rolls=6, finalists=2))
    assert len(planner.run(8).grasps) >= 4
    nowhere = replace(dclaw, canonical_box=np.array([centre - 0.01, centre + 0.01]))
    with pytest.raises(HandError, match="'dclaw' has no palm, and its canonical_box"):
        palm_axis(nowhere)

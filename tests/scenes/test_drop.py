"""Objects dropped on a table lie on it, still and apart."""

import numpy as np
import pytest
import trimesh

from lgrasp.errors import PhysicsError
from lgrasp.geometry.poses import pose_matrix
from lgrasp.scenes.drop import drop
from lgrasp.scenes.params import DropParams
from lgrasp.simulate.solid import Solid

SIDES = np.array([0.05, 0.07, 0.1])
SHIFT = np.array([3.01, -2.02, 5.03])  # of the box in its own frame


def solid(mesh: trimesh.Trimesh, name: str) -> Solid:
    return Solid(name, (np.asarray(mesh.vertices),), mesh.volume, mesh.center_mass, mesh.moment_inertia, 0.0)


@pytest.fixture(scope="module")
def solids():
    box = trimesh.creation.box(SIDES).apply_translation(SHIFT)
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.035)
    return [solid(box, "box"), solid(ball, "ball"), solid(box, "box")]


def test_at_rest_on_the_table(solids):
    settled = drop(solids, 0.8, DropParams(), np.random.default_rng(4))
    T = pose_matrix(settled.pose)
    points = [np.vstack(s.pieces) @ m[:3, :3].T + m[:3, 3] for s, m in zip(solids, T, strict=True)]
    for p in points:
        assert abs(p[:, 2].min()) < 1e-3  # neither in the air nor sunk in: each lies by itself
        assert np.abs(p[:, :2]).max() < 0.4
    for k in (0, 2):  # a box lies on one of its faces
        up = np.abs(T[k][2, :3]).max()
        assert up > np.cos(np.radians(1))
        height = (T[k][:3, :3] @ SHIFT + T[k][:3, 3])[2]
        assert np.abs(height - SIDES / 2).min() < 1e-3
    assert abs(T[1][2, 3] - 0.035) < 1e-3
    assert (settled.pose[:, 3] >= 0).all()
    np.testing.assert_allclose(np.linalg.norm(settled.pose[:, 3:], axis=1), 1, atol=1e-9)


@pytest.mark.parametrize("away", [5.0, 30.0])
def test_a_frame_far_from_its_object(away: float):
    """As that of a part that is cut out of a large scan."""
    box = trimesh.creation.box(SIDES).apply_translation([0, 0, away])
    settled = drop([solid(box, "box")], 0.8, DropParams(), np.random.default_rng(4))
    assert settled.tries == 1
    points = trimesh.transform_points(box.vertices, pose_matrix(settled.pose)[0])
    assert abs(points[:, 2].min()) < 1e-3
    assert np.abs(points[:, :2]).max() < 0.4


def test_same_seed_same_poses(solids):
    runs = [drop(solids, 0.8, DropParams(), np.random.default_rng(seed)).pose for seed in (1, 1, 2)]
    np.testing.assert_array_equal(runs[0], runs[1])
    assert np.abs(runs[0] - runs[2]).max() > 0.01


def test_a_table_that_is_too_small(solids):
    with pytest.raises(PhysicsError, match=r"'ball', 'box' did not come to rest on a table of 0.04 m in 2 tries"):
        drop(solids, 0.04, DropParams(tries=2), np.random.default_rng(0))

"""Points on a link's surface."""

import numpy as np
import trimesh
from scipy.spatial import KDTree

from lgrasp.hand.geometry import surface_samples

SPACING = 0.004


def test_samples_lie_along_the_edges_of_a_box():
    half = np.array([0.025, 0.015, 0.008])
    samples = surface_samples(trimesh.creation.box(extents=2 * half), SPACING, np.random.default_rng(0))
    np.testing.assert_allclose(np.abs(np.abs(samples) / half).max(1), 1.0, atol=1e-9)
    on_edge = samples[np.isclose(np.abs(samples), half).sum(1) >= 2]
    for axis in range(3):
        edge = np.tile(half, (200, 1))
        edge[:, axis] = np.linspace(-half[axis], half[axis], 200)
        assert KDTree(on_edge).query(edge)[0].max() <= SPACING

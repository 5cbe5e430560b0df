"""Hulls of fewer corners are as near to the hull as they say."""

import numpy as np
import pytest
import trimesh
from support.convex import hull_distance

from lgrasp.geometry.hulls import fewer_corners


def ball() -> np.ndarray:
    """Corners of a ball of 3 cm."""
    return np.asarray(trimesh.creation.icosphere(subdivisions=4, radius=0.03).vertices)


def rod() -> np.ndarray:
    """Corners of a cylinder: flat sides and round edges."""
    return np.asarray(trimesh.creation.cylinder(radius=0.02, height=0.05, sections=128).vertices)


def wedge() -> np.ndarray:
    """Corners of a blade with a bowed edge of 12 degrees: much farther from the hull without them than from its
    planes."""
    y = np.linspace(-0.03, 0.03, 61)
    back = np.column_stack([np.full((122), -0.02), np.tile(y, 2), np.repeat([-0.002, 0.002], 61)])
    return np.vstack([back, np.column_stack([0.002 - 3 * y**2, y, np.zeros(61)])])


@pytest.mark.parametrize("make", [ball, rod, wedge])
@pytest.mark.parametrize("most", [2.0e-4, 1.0e-3])
def test_no_corner_is_left_out_by_more_than_it_says(make, most: float):
    corners = trimesh.convex.convex_hull(make()).vertices
    kept = fewer_corners(corners, most)
    assert len(kept) < len(corners)
    left_out = np.delete(corners, kept, axis=0)
    rng = np.random.default_rng(0)
    for corner in rng.permutation(left_out)[:40]:
        assert hull_distance(corner[None], corners[kept]) < most * 1.001


def test_the_more_error_the_fewer_corners():
    counts = [len(fewer_corners(ball(), most)) for most in (2.0e-4, 5.0e-4, 1.0e-3)]
    assert counts[0] < len(ball()) / 2
    assert counts[0] > counts[1] > counts[2]


def test_a_box_keeps_its_corners():
    assert len(fewer_corners(np.asarray(trimesh.creation.box([0.03, 0.04, 0.05]).vertices), 2.0e-4)) == 8

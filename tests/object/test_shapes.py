"""Random solids: watertight, one body, of the size asked for; things that hold something are hollow."""

from typing import get_args

import numpy as np
import pytest

from lgrasp.choices import ShapeKind
from lgrasp.object.shapes import deformed_shape, random_shape


@pytest.mark.parametrize("kind", [None, *get_args(ShapeKind)])
def test_shapes(kind):
    mesh = random_shape(3, 1, kind, (0.04, 0.12))
    assert mesh.is_watertight
    assert mesh.body_count == 1
    assert mesh.volume > 0
    assert 0.04 <= mesh.extents.max() <= 0.12
    assert np.array_equal(mesh.vertices, random_shape(3, 1, kind, (0.04, 0.12)).vertices)
    assert not np.array_equal(mesh.bounds, random_shape(4, 1, kind, (0.04, 0.12)).bounds)
    assert random_shape(3, 1, kind).extents.max() <= 0.2201


def test_mugs_and_bowls_are_hollow():
    for kind in ("mug", "bowl", "plate"):
        mesh = random_shape(0, 0, kind)
        assert mesh.volume < 0.6 * mesh.convex_hull.volume, kind
        middle = mesh.bounds.mean(0) * [0, 1, 0] + [0, 0, mesh.bounds[1, 2] - 1e-3]
        assert not mesh.contains([middle])[0], kind


def test_deformed_solids_are_still_solids():
    for number, kind in enumerate(["box", "mug"]):
        mesh = random_shape(0, 0, kind)
        deformed = [deformed_shape(mesh, np.random.default_rng(seed)) for seed in (number, number, 9)]
        assert all(one.is_watertight and one.volume > 0 for one in deformed)
        assert max(one.extents.max() for one in deformed) <= 0.2201
        assert np.array_equal(deformed[0].vertices, deformed[1].vertices)
        assert not np.allclose(deformed[0].extents, deformed[2].extents)
        assert not np.allclose(deformed[0].extents, mesh.extents)

"""Distance grids in torch against the Warp look-up, a sphere, and finite differences."""

import numpy as np
import pytest
import torch
from support.look_up import look_up

from lgrasp.differentiable.distance import DistanceGrids, SurfaceNormals
from lgrasp.object.sdf import SdfGrid

RADIUS = 0.02


def sphere(cell: float, shape: tuple[int, int, int], origin: list[float]) -> SdfGrid:
    at = np.array(origin) + cell * np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), -1)
    return SdfGrid((np.linalg.norm(at, axis=-1) - RADIUS).astype(np.float32), np.array(origin, np.float32), cell)


GRIDS = [sphere(0.004, (21, 26, 31), [-0.04, -0.05, -0.06]), sphere(0.003, (23, 19, 21), [-0.031, -0.028, -0.03])]


def around(grid: SdfGrid, n: int, reach: float) -> np.ndarray:
    """Points in a box about the grid's, ``reach`` times as large."""
    half = 0.5 * grid.cell * (np.array(grid.values.shape) - 1)
    return grid.origin + half + reach * half * np.random.default_rng(0).uniform(-1, 1, (n, 3))


@pytest.mark.parametrize("reach", [0.95, 2.5])
def test_values_equal_those_of_the_kernels_in_each_grid(reach):
    both = DistanceGrids(GRIDS)
    points = [around(g, 2000, reach).astype(np.float32) for g in GRIDS]
    p = torch.from_numpy(np.concatenate(points))
    number = torch.arange(2).repeat_interleave(2000)
    value = both.value(p, number)
    x, y, z = p.unbind(-1)
    again, gradient = both.value_and_gradient((x, y, z), number)
    theirs = [look_up("cpu", g.values, g.origin, g.cell, points) for g, points in zip(GRIDS, points, strict=True)]
    np.testing.assert_allclose(value.numpy(), np.concatenate([v for v, _ in theirs]), atol=2e-7)
    torch.testing.assert_close(again, value)
    if reach < 1:  # the kernels give unit vectors
        slope = torch.stack(gradient, -1).numpy()
        slope /= np.linalg.norm(slope, axis=1, keepdims=True)
        np.testing.assert_allclose(slope, np.concatenate([g[:, :3] for _, g in theirs]), atol=2e-3)


@pytest.mark.parametrize("reach", [0.95, 2.5])
def test_values_within_do_not_depend_on_other_grids(reach):
    p = torch.from_numpy(around(GRIDS[0], 3000, reach).astype(np.float32)).reshape(100, 30, 3)
    x, y, z = p.unbind(-1)
    number = torch.zeros(100, 1, dtype=torch.int64)
    alone, among = (DistanceGrids(grids).value_within((x, y, z), number) for grids in (GRIDS[:1], GRIDS))
    torch.testing.assert_close(alone, among, atol=1e-5, rtol=0)
    if reach < 1:
        torch.testing.assert_close(alone, DistanceGrids(GRIDS).value(p, 0), atol=1e-6, rtol=0)


@pytest.mark.parametrize("reach", [0.95, 2.5])
def test_derivatives_equal_finite_differences(reach):
    grids = DistanceGrids(GRIDS, dtype=torch.float64)
    p = torch.from_numpy(around(GRIDS[1], 40, reach)).requires_grad_()
    assert torch.autograd.gradcheck(lambda p: grids.value(p, 1), p, eps=1e-8, atol=1e-6)
    assert torch.autograd.gradgradcheck(lambda p: grids.value(p, 1), p, eps=1e-8, atol=1e-4)
    normals = SurfaceNormals(GRIDS[1], dtype=torch.float64)
    assert torch.autograd.gradcheck(normals, p, eps=1e-8, atol=1e-5)


def test_beyond_the_grid_values_stay_below_the_distance_and_grow_with_it():
    grid = GRIDS[0]
    p = around(grid, 3000, 3.0)
    value = DistanceGrids([grid], dtype=torch.float64).value(torch.from_numpy(p)).numpy()
    true = np.linalg.norm(p, axis=1) - RADIUS
    assert (value < true + 5e-4).all()  # half a millimetre of interpolation at cells of 4 mm
    further = DistanceGrids([grid], dtype=torch.float64).value(torch.from_numpy(p * 1.1)).numpy()
    assert (further > value)[true > 0].all()


def test_normals_of_a_sphere_and_how_they_turn():
    grid = sphere(0.002, (31, 31, 31), [-0.03, -0.03, -0.03])
    normals = SurfaceNormals(grid, dtype=torch.float64)
    d = np.random.default_rng(1).normal(size=(200, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    p = torch.from_numpy(RADIUS * d).requires_grad_()
    n = normals(p)
    assert ((n.detach().numpy() * d).sum(1) > np.cos(np.radians(0.5))).all()
    # a sphere's normals turn by 1 / radius per metre in every tangent direction
    turning = torch.stack([torch.autograd.grad(n[:, a].sum(), p, retain_graph=True)[0] for a in range(3)], 1)
    outward = d[:, :, None] * d[:, None]
    np.testing.assert_allclose(turning.numpy() * RADIUS, np.eye(3) - outward, atol=0.2)
    beyond = torch.from_numpy(0.2 * d)
    assert ((normals(beyond).numpy() * d).sum(1) > np.cos(np.radians(8))).all()

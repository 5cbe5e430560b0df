"""Distance grid look-ups against NumPy's own interpolation, and what they promise outside the grid."""

import numpy as np
import pytest
from support.look_up import look_up, look_up_limits
from support.sdf import trilinear, trilinear_gradient

SHAPE, CELL, ORIGIN, RADIUS = (21, 26, 31), 0.004, np.array([-0.04, -0.05, -0.06]), 0.02


def nodes() -> np.ndarray:
    return ORIGIN + CELL * np.stack(np.meshgrid(*(np.arange(n) for n in SHAPE), indexing="ij"), -1)


def inside(n: int, seed: int) -> np.ndarray:
    return ORIGIN + CELL * np.random.default_rng(seed).uniform(0, np.array(SHAPE) - 1.01, (n, 3))


def test_value_and_gradient_are_trilinear(device):
    values = np.random.default_rng(0).normal(size=SHAPE) * 0.01
    p = inside(5000, 1)
    value, gradient = look_up(device, values, ORIGIN, CELL, p, first=17)
    np.testing.assert_allclose(value, trilinear(values, ORIGIN, CELL, p), atol=2e-7)
    np.testing.assert_allclose(gradient[:, 3], value, atol=1e-7)
    slope = trilinear_gradient(values, ORIGIN, CELL, p)
    slope /= np.linalg.norm(slope, axis=1, keepdims=True)
    assert np.quantile(np.abs(gradient[:, :3] - slope).max(1), 0.999) < 1e-3  # a vanishing slope has no direction
    np.testing.assert_allclose(np.linalg.norm(gradient[:, :3], axis=1), 1, atol=1e-5)


def test_nodes_are_met_exactly(device):
    values = np.random.default_rng(2).normal(size=SHAPE) * 0.01
    p = nodes()[:-1, :-1, :-1].reshape(-1, 3)
    value, _ = look_up(device, values, ORIGIN, CELL, p)
    np.testing.assert_allclose(value, values[:-1, :-1, :-1].ravel(), atol=3e-7)


def test_last_layer_is_not_lost(device):
    values = np.random.default_rng(3).normal(size=SHAPE) ** 2 * 0.01 + 0.001
    top = nodes()[-1].reshape(-1, 3)
    value, gradient = look_up(device, values, ORIGIN, CELL, top)
    np.testing.assert_allclose(value, values[-1].ravel(), atol=2e-4)
    assert np.isfinite(gradient).all()


def test_far_points_get_a_lower_bound(device):
    """A ball in the middle of the grid; points up to a metre away."""
    values = np.linalg.norm(nodes(), axis=-1) - RADIUS
    rng = np.random.default_rng(4)
    u = rng.normal(size=(5000, 3))
    p = u / np.linalg.norm(u, axis=1, keepdims=True) * rng.uniform(0.0, 1.0, (5000, 1))
    exact = np.linalg.norm(p, axis=1) - RADIUS
    x = (p - ORIGIN) / CELL
    outside = ((x < 0) | (x > np.array(SHAPE) - 1)).any(1)
    value, gradient = look_up(device, values, ORIGIN, CELL, p)
    assert outside.sum() > 3000
    assert (value[outside] <= exact[outside] + 1e-4).all()  # 0.1 mm of interpolation
    # positive outside, and not worse than half: a ray to the grid's surface and the rest of the way back
    assert (value[outside] > 0).all()
    assert (gradient[outside, 3] >= 0.3 * exact[outside]).all()
    np.testing.assert_allclose(np.linalg.norm(gradient[:, :3], axis=1), 1, atol=1e-4)
    # beyond the grid the direction still leads to the ball
    along = (gradient[outside, :3] * p[outside]).sum(1) / np.linalg.norm(p[outside], axis=1)
    assert along.min() > 0.8


@pytest.mark.parametrize("p", [[1e9, 0, 0], [-1e9, 1e9, 1e9], [0, 0, -1e6]])
def test_absurd_points_are_far(device, p):
    values = np.linalg.norm(nodes(), axis=-1) - RADIUS
    value, gradient = look_up(device, values, ORIGIN, CELL, np.array([p], float))
    assert value[0] > 1e5
    assert np.isfinite(gradient).all()


def test_flat_grid_has_no_direction_but_is_finite(device):
    value, gradient = look_up(device, np.full(SHAPE, 0.01), ORIGIN, CELL, inside(50, 5))
    np.testing.assert_allclose(value, 0.01)
    assert np.isfinite(gradient).all()


@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("limit", [-0.004, 0.0, 0.011])
def test_limits_are_those_of_the_values(device, blocks, limit):
    """A ball; points inside and outside of the grid."""
    values = np.linalg.norm(nodes(), axis=-1) - RADIUS
    p = np.random.default_rng(5).uniform(-0.09, 0.09, (20_000, 3))
    value, _ = look_up(device, values, ORIGIN, CELL, p)
    below, depth = look_up_limits(device, values, ORIGIN, CELL, p, limit, blocks=blocks)
    np.testing.assert_array_equal(below, value < np.float32(limit))
    np.testing.assert_array_equal(depth, np.maximum(-value, np.float32(limit)))

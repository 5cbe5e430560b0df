"""Trilinear interpolation in a grid of distances."""

import numpy as np

__all__ = ["trilinear", "trilinear_gradient"]


def _cell(values: np.ndarray, origin: np.ndarray, cell: float, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    x = np.clip((p - origin) / cell, 0, np.array(values.shape) - 1)
    index = np.minimum(x.astype(int), np.array(values.shape) - 2)
    corner = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
    at = index[:, None] + corner  # (n, 8, 3)
    return values[at[..., 0], at[..., 1], at[..., 2]].reshape(-1, 2, 2, 2), x - index


def trilinear(values: np.ndarray, origin: np.ndarray, cell: float, p: np.ndarray) -> np.ndarray:
    """Value [m] at points p (n, 3), clamped into the grid."""
    v, f = _cell(values, origin, cell, p)
    w = [np.stack([1 - f[:, a], f[:, a]], 1) for a in range(3)]
    return np.einsum("nijk,ni,nj,nk->n", v, *w)


def trilinear_gradient(values: np.ndarray, origin: np.ndarray, cell: float, p: np.ndarray) -> np.ndarray:
    """Gradient (n, 3) of the interpolant at points inside the grid."""
    v, f = _cell(values, origin, cell, p)
    w = [np.stack([1 - f[:, a], f[:, a]], 1) for a in range(3)]
    s = np.tile([-1.0, 1.0], (len(p), 1))
    weights = [[s if a == b else w[b] for b in range(3)] for a in range(3)]
    return np.stack([np.einsum("nijk,ni,nj,nk->n", v, *w3) for w3 in weights], 1) / cell

"""Normals of scattered points: planes through neighbours, turned towards where the points were seen from."""

import numpy as np
from scipy.spatial import KDTree

NEIGHBOURS = 24
"""Points, the point itself among them, through which a plane is laid."""

_BLOCK = 65_536  # points at a time, for memory


def estimate_normals(points: np.ndarray, neighbours: int = NEIGHBOURS) -> np.ndarray:
    """Unit normals of the planes that fit each point and its nearest neighbours best; either side may be meant.

    Args:
        points: [m], shape (n, 3), n >= 3.

    Returns:
        Shape (n, 3), f64.
    """
    tree, k = KDTree(points), min(neighbours, len(points))
    out = np.empty((len(points), 3))
    for at in range(0, len(points), _BLOCK):
        near = points[tree.query(points[at : at + _BLOCK], k)[1]]  # (b, k, 3)
        near = near - near.mean(axis=1, keepdims=True)
        out[at : at + _BLOCK] = np.linalg.eigh(np.einsum("bki,bkj->bij", near, near))[1][:, :, 0]
    return out


def face_viewpoint(points: np.ndarray, normals: np.ndarray, viewpoint: np.ndarray) -> np.ndarray:
    """Which normals point away from a viewpoint (3,) [m]: flags, shape (n,)."""
    return np.einsum("nd,nd->n", normals, viewpoint - points) < 0.0

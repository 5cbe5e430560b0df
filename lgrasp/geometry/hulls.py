"""Convex hulls of points, and hulls of fewer corners that differ from them by a bounded error."""

import numpy as np
import trimesh
from scipy.spatial import ConvexHull

_FIRST_CORNERS = 24  # those farthest along so many directions are kept


def convex_hull(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Corners (V, 3) of the hull of points (n, 3), and its planes (P, 4) as normal and offset.

    Raises:
        scipy.spatial.QhullError: flat points.
    """
    hull = ConvexHull(points)
    planes = np.unique(np.round(hull.equations, 9), axis=0)
    return points[hull.vertices], np.column_stack([planes[:, :3], -planes[:, 3]])


def spread_directions(n: int) -> np.ndarray:
    """n well-spread unit vectors (Fibonacci), (n, 3)."""
    i = np.arange(n) + 0.5
    phi, theta = np.arccos(1 - 2 * i / n), np.pi * (1 + 5**0.5) * i
    return np.column_stack([np.cos(theta) * np.sin(phi), np.sin(theta) * np.sin(phi), np.cos(phi)])


def farthest_corners(corners: np.ndarray, n: int) -> np.ndarray:
    """Places (k <= n,) of those of corners (V, 3) that are farthest along n spread directions."""
    return np.unique(np.argmax(corners @ spread_directions(n).T, axis=0))


def fewer_corners(corners: np.ndarray, most: float, *, apart: bool = True) -> np.ndarray:
    """Places of corners (V, 3) [m] of a hull whose own hull leaves out no other by more than ``most`` [m].

    Where directions miss what matters, as at edges and flat sides: whatever is farthest out of each face is added.

    Args:
        apart: measured to the hull itself; else to the planes of its faces, which is less beside sharp edges.

    Raises:
        scipy.spatial.QhullError: flat corners.
    """
    kept = farthest_corners(corners, _FIRST_CORNERS)
    while True:
        thin, planes = convex_hull(corners[kept])
        excess = corners @ planes[:, :3].T - planes[:, 3]
        more = excess.argmax(0)[excess.max(0) > most]
        if apart and not len(more):
            distance = _distances(corners, thin)
            more = [distance.argmax()] if distance.max() > most else []
        before, kept = len(kept), np.union1d(kept, more).astype(int)
        if len(kept) == before:
            return kept


def _distances(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """How far points (n, 3) are out of the hull of corners (V, 3), (n,)."""
    hull = ConvexHull(corners)
    height = points @ hull.equations[:, :3].T + hull.equations[:, 3]
    point, face = np.nonzero(height > 0)  # the nearest place is on a face that the point sees
    triangles = corners[hull.simplices[face]]
    nearest = trimesh.triangles.closest_point(triangles, points[point])
    distances = np.full(len(points), np.inf)
    np.minimum.at(distances, point, np.linalg.norm(points[point] - nearest, axis=1))
    return np.where(np.isinf(distances), 0.0, distances)

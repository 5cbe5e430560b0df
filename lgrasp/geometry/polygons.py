"""Polygons in space, cut into triangles."""

import numpy as np

_BENT = 1e-6  # sine of a turn the other way that is none, of rounding


def cut_polygons(vertices: np.ndarray, corners: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Triangles of polygons: a fan from the first corner of a convex one, ears of another, in the plane that it is
    nearest to.

    Args:
        vertices: shape (v, 3).
        corners: indices of all polygons, one after another, shape (c,).
        sizes: corners of each, at least 3, shape (p,).

    Returns:
        Faces, shape (c - 2 p, 3), and the polygon that each is of, ascending, shape (c - 2 p,).
    """
    start = np.cumsum(sizes) - sizes
    of = np.repeat(np.arange(len(sizes)), sizes - 2)
    nth = np.arange(len(of)) - np.repeat(np.cumsum(sizes - 2) - (sizes - 2), sizes - 2)
    at = start[of]
    faces = np.stack([corners[at], corners[at + nth + 1], corners[at + nth + 2]], axis=1)
    for k in _concave(vertices, corners, start, sizes):
        own = corners[start[k] : start[k] + sizes[k]]
        cut = _ears(vertices[own])
        if len(cut) == sizes[k] - 2:  # else it crosses itself
            faces[np.flatnonzero(of == k)] = own[cut]
    return faces, of


def _concave(vertices: np.ndarray, corners: np.ndarray, start: np.ndarray, sizes: np.ndarray) -> np.ndarray:
    """Numbers of the polygons that turn both ways."""
    found = [np.zeros(0, int)]
    for size in np.unique(sizes[sizes > 3]):
        these = np.flatnonzero(sizes == size)
        points = vertices[corners[start[these][:, None] + np.arange(size)]]
        side = np.roll(points, -1, axis=1) - points
        turn = np.cross(np.roll(side, 1, axis=1), side)
        normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
        length = np.linalg.norm(side, axis=2)
        least = -_BENT * length * np.roll(length, 1, axis=1) * np.linalg.norm(normal, axis=1)[:, None]
        found.append(these[(np.einsum("pcd,pd->pc", turn, normal) < least).any(axis=1)])
    return np.concatenate(found)


def _ears(points: np.ndarray) -> np.ndarray:
    """Triangles (t, 3) of a polygon with corners (c, 3), wound as it is."""
    import mapbox_earcut  # where it is used

    centred = points - points.mean(axis=0)
    normal = np.cross(centred, np.roll(centred, -1, axis=0)).sum(axis=0)
    axes = np.linalg.svd(centred - np.outer(centred @ normal, normal) / (normal @ normal))[2][:2]
    flat = np.ascontiguousarray(centred @ axes.T)
    cut = mapbox_earcut.triangulate_float64(flat, np.array([len(points)], np.uint32)).reshape(-1, 3).astype(int)
    a, b, c = centred[cut].transpose(1, 0, 2)
    turned = np.cross(b - a, c - a) @ normal < 0
    cut[turned] = cut[turned, ::-1]
    return cut

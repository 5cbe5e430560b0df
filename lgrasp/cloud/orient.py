"""Which side of a cloud's surface is its outside: a camera tells, or views from all around it."""

import numpy as np
from scipy.spatial import ConvexHull, KDTree

from lgrasp.geometry.hulls import spread_directions

_MOST_POINTS = 20_000  # that views look at
_VIEWS = 40
_FAR = 3.0  # of a view from the middle, over the cloud's diagonal
_FLIP = 100.0  # radius of the mirror of _visible, over the farthest point
_MOST_THROUGH = 0.09  # where one camera saw a cloud: 0.07 of eleven objects with 3 mm of noise
_SPACINGS, _NOISES = 5.0, 4.0  # of a step in depth from one surface to another
_NEIGHBOURS, _ROUNDS = 9, 10  # of what is passed on between points


def shows_all_sides(points: np.ndarray) -> bool:
    """Whether no camera can have seen a cloud, (n, 3): from everywhere, points lie behind others."""
    points = _some(points)
    spacing = _spacing(points)
    return all(_through(points, eye, spacing) > _MOST_THROUGH for eye in _eyes(points))


def seen_from(points: np.ndarray, eye: np.ndarray) -> bool:
    """Whether a camera at a place, (3,), can have seen a cloud, (n, 3)."""
    points = _some(points)
    return _through(points, eye, _spacing(points)) <= _MOST_THROUGH


def outward(points: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Unit normals (n, 3) turned outwards: to those of the views from all around that see a point and its neighbours.

    Visible is what hidden point removal leaves (Katz et al. 2007). Where two surfaces are nearer to each other than a
    few points, as in a thin wall, it cannot tell them apart.
    """
    some = _some(points)
    tree = KDTree(some)
    index = tree.query(points)[1]
    own = np.empty_like(some)
    own[index] = normals  # of one of the points that are nearest
    votes = np.zeros(len(some))
    middle = (some.min(axis=0) + some.max(axis=0)) / 2
    for eye in _eyes(some):
        seen = _visible(some, eye)
        way = eye - middle
        votes[seen] += own[seen] @ (way / np.linalg.norm(way))
    distance, near = tree.query(some, min(_NEIGHBOURS, len(some)))
    way = (some[near] - some[:, None]) / np.maximum(distance, 1e-12)[..., None]
    alike = np.einsum("nkd,nd->nk", own[near], own)
    # a neighbour across an edge or a wall tells little
    weight = np.maximum(np.abs(alike) - np.abs(np.einsum("nkd,nd->nk", way, own)), 0.0) * np.sign(alike)
    weight[:, 0] = 1.0
    for _ in range(_ROUNDS):
        votes = np.clip((weight * votes[near]).sum(axis=1), -5.0, 5.0)
    told = np.where(votes < 0.0, -1.0, 1.0)[:, None] * own
    return np.where(np.einsum("nd,nd->n", told[index], normals) < 0.0, -1.0, 1.0)[:, None] * normals


def _some(points: np.ndarray) -> np.ndarray:
    return points[:: -(-len(points) // _MOST_POINTS)]


def _eyes(points: np.ndarray) -> np.ndarray:
    low, high = points.min(axis=0), points.max(axis=0)
    return (low + high) / 2 + _FAR * np.linalg.norm(high - low) * spread_directions(_VIEWS)


def _spacing(points: np.ndarray) -> float:
    return float(np.median(KDTree(points).query(points, 2)[0][:, 1]))


def _through(points: np.ndarray, eye: np.ndarray, spacing: float) -> float:
    """Share of points whose neighbour in a picture lies much nearer or farther: one surface behind another."""
    way = points - eye
    axis = way.mean(axis=0) / max(float(np.linalg.norm(way.mean(axis=0))), 1e-12)
    depth = way @ axis
    if (depth <= 0.0).any():
        return 1.0  # the camera would be among the points
    picture = (way @ np.linalg.svd(axis[None])[2][1:].T) * (np.median(depth) / depth)[:, None]
    step = np.abs(depth - depth[KDTree(picture).query(picture, 2)[1][:, 1]])
    noise = np.quantile(step, 0.25) / 0.45  # of depths, were their differences normally distributed
    return float((step > max(_SPACINGS * spacing, _NOISES * noise)).mean())


def _visible(points: np.ndarray, eye: np.ndarray) -> np.ndarray:
    """Indices of the points that are seen from a place: mirrored at a sphere around it, corners of their hull."""
    way = points - eye
    far = np.linalg.norm(way, axis=1, keepdims=True)
    mirrored = way * (2.0 * _FLIP * far.max() / far - 1.0)
    corners = ConvexHull(np.vstack([mirrored, np.zeros(3)])).vertices
    return corners[corners < len(points)]

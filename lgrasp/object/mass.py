"""Volume, centre of mass and inertia of a mesh at uniform density: one rule for all that asks."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError

from lgrasp.errors import ObjectError
from lgrasp.geometry.edges import bodies, open_edges

_FLAT = 1e-6  # of the spreads of points along their main axes, the least over the largest
_LEAST_VOLUME = 1e-12  # over the cubed largest side; a closed mesh of less bounds nothing
_OVERLAP = 1e-4  # of the volume; what is less than that is not told from rounding


class MassProperties(NamedTuple):
    """Of a body of density 1, in the frame of its vertices."""

    volume: float
    """[m³]"""
    center: np.ndarray
    """Centre of mass [m], shape (3,)."""
    inertia: np.ndarray
    """Second moments about the centre of mass [m⁵], shape (3, 3)."""
    solid: bool
    """Whether it is the mesh itself, which is closed; else its convex hull."""


def mass_properties(vertices: np.ndarray, faces: np.ndarray) -> MassProperties:
    """Mass properties of what a mesh bounds; of its convex hull if it is open, bounds nothing, or has no faces. Where
    bodies of a closed mesh overlap, there is one body.

    Args:
        vertices: [m], shape (v, 3); those at one place are one.
        faces: vertex indices, outward winding, shape (f, 3).

    Raises:
        ObjectError: a mesh that is not closed, and flat.
    """
    points, faces = np.asarray(vertices, float), np.asarray(faces)
    origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
    points = points - origin
    found = _solid_mesh(points, faces) if len(faces) else None
    closed = found is not None
    if found is None:
        found = _solid_hull(points[np.unique(faces)] if len(faces) else points)
    if found is None:
        raise ObjectError("a flat mesh has no mass; a solid is accepted")
    volume, center, inertia = found
    return MassProperties(volume, origin + center, inertia, closed)


def _solid_mesh(points: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
    """:func:`_solid` of a mesh, of which no part counts twice; None if an edge is not matched by its opposite."""
    places, joined = np.unique(points, axis=0, return_inverse=True)
    joined = joined.ravel()[faces]
    joined = joined[(joined != np.roll(joined, 1, axis=1)).all(axis=1)]
    if not len(joined) or len(open_edges(joined)):
        return None
    union = united_bodies(places, joined)
    return _solid(points, faces) if union is None else _solid(*union)


def united_bodies(points: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
    """Vertices (v, 3) and faces (f, 3) of all bodies of a closed mesh as one, where bodies overlap or touch; None where
    they do not, or have no union."""
    body = bodies(faces)
    if not body.any():  # one
        return None
    corners = points[faces] - points.mean(axis=0)
    volume = np.bincount(body, np.linalg.det(corners) / 6.0)
    shells = [trimesh.Trimesh(points, faces[body == k], process=False) for k in range(len(volume))]
    low, high = (np.array([shell.bounds[end] for shell in shells]) for end in (0, 1))
    solid = np.flatnonzero(volume > 0.0)
    meets = ((low[solid, None] <= high[solid]) & (low[solid] <= high[solid, None])).all(axis=-1)
    if meets.sum() == len(solid):  # with itself alone
        return None
    parts = {k: [shells[k]] for k in solid}
    for k in np.flatnonzero(volume < 0.0):  # a cavity of the smallest that is about it
        about = [o for o in solid if (low[o] < low[k]).all() and (high[o] > high[k]).all()]
        if about:
            parts[min(about, key=volume.__getitem__)].append(shells[k])
    try:
        union = trimesh.boolean.union([trimesh.util.concatenate(each) for each in parts.values()], engine="manifold")
    except (ValueError, RuntimeError):
        return None
    whole = np.asarray(union.vertices, float), np.asarray(union.faces, np.int64)
    if not len(whole[1]) or len(open_edges(whole[1])):
        return None
    smaller = union.volume < (1.0 - _OVERLAP) * volume.sum()
    return whole if smaller or bodies(whole[1]).max() < body.max() else None


def _solid_hull(points: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
    """:func:`_solid` of a convex hull; None if the points are in a plane."""
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if len(points) < 4 or spread[2] < _FLAT * spread[0]:
        return None
    try:
        hull = trimesh.convex.convex_hull(points)
    except QhullError:
        return None
    return _solid(np.asarray(hull.vertices), np.asarray(hull.faces))


def _solid(points: np.ndarray, faces: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Volume, centre and inertia by signed tetrahedra with the origin; None without a volume."""
    corners = points[faces]
    weight = np.linalg.det(corners) / 6.0
    volume = weight.sum()
    if not volume > _LEAST_VOLUME * np.ptp(points, axis=0).max() ** 3:
        return None
    center = weight @ corners.sum(axis=1) / 4.0 / volume
    arms = corners - center
    # over a tetrahedron with corners 0, a, b, c the mean of x xᵀ is (aaᵀ + bbᵀ + ccᵀ + ssᵀ) / 20, s = a + b + c
    share = np.linalg.det(arms) / 120.0
    both = np.concatenate([arms, arms.sum(axis=1, keepdims=True)], axis=1)
    moment = np.einsum("f,fki,fkj->ij", share, both, both, optimize=True)
    return float(volume), center, np.trace(moment) * np.eye(3) - moment

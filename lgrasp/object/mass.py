"""Volume, centre of mass and inertia of a mesh at uniform density: one rule for all that asks."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import QhullError

from lgrasp.errors import ObjectError
from lgrasp.geometry.edges import open_edges

_FLAT = 1e-6  # of the spreads of points along their main axes, the least over the largest
_LEAST_VOLUME = 1e-12  # over the cubed largest side; a closed mesh of less bounds nothing


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
    """Mass properties of what a mesh bounds; of its convex hull if it is open, bounds nothing, or has no faces.

    Args:
        vertices: [m], shape (v, 3); those at one place are one.
        faces: vertex indices, outward winding, shape (f, 3).

    Raises:
        ObjectError: a mesh that is not closed, and flat.
    """
    points, faces = np.asarray(vertices, float), np.asarray(faces)
    origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
    points = points - origin
    found = _solid(points, faces) if len(faces) and _closed(points, faces) else None
    closed = found is not None
    if found is None:
        found = _solid_hull(points[np.unique(faces)] if len(faces) else points)
    if found is None:
        raise ObjectError("a flat mesh has no mass; a solid is accepted")
    volume, center, inertia = found
    return MassProperties(volume, origin + center, inertia, closed)


def _closed(points: np.ndarray, faces: np.ndarray) -> bool:
    """True if every directed edge is matched by its opposite."""
    joined = np.unique(points, axis=0, return_inverse=True)[1].ravel()[faces]
    return not len(open_edges(joined[(joined != np.roll(joined, 1, axis=1)).all(axis=1)]))


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

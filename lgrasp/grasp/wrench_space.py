"""The grasp wrench space, exactly: the convex hull of the wrenches that a grasp's contacts can put on the object."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import ConvexHull

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.math.constants import CONE_EDGES

FRICTION: float = GraspBounds.model_fields["friction"].default
"""Of the strict bounds."""

_EPSILON_ROUNDING = 1e-8  # epsilon below this is rounding: the origin lies on the hull or outside


class WrenchSpace(NamedTuple):
    """Quality of a grasp from its hull."""

    epsilon: float
    """Largest ball about the origin inside the hull (Ferrari and Canny's quality); 0 when the origin is not inside."""
    volume: float
    """6-D volume of the hull; 0 when the origin is not inside."""


def cone_edges(normals: np.ndarray, *, friction: float, edges: int) -> np.ndarray:
    """Forces of unit normal part along the edges of friction pyramids.

    Args:
        normals: Unit normals into the object, shape [k, 3].
        friction: Coefficient of friction; 0 gives the normals alone.
        edges: Edges of each pyramid; the first lies along normal x (axis of the normal's smallest component).

    Returns:
        Forces, shape [k, edges, 3]; [k, 1, 3] without friction.
    """
    if friction == 0:
        return normals[:, None]
    t = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    b = np.cross(normals, t)
    angle = 2 * np.pi * np.arange(edges)[:, None] / edges
    around = np.cos(angle) * t[:, None] + np.sin(angle) * b[:, None]  # (k, edges, 3)
    return normals[:, None] + friction * around


def primitive_wrenches(
    points: np.ndarray,
    normals: np.ndarray,
    *,
    center: np.ndarray,
    radius: float,
    friction: float,
    edges: int = CONE_EDGES,
) -> np.ndarray:
    """Wrenches (f, (p - center) x f / radius) of the forces f of :func:`cone_edges`, shape [k * edges, 6].

    Args:
        points: Contact points [m], shape [k, 3].
        normals: Unit normals into the object, shape [k, 3].
        center: Point that torques are taken about, the object's centre of mass [m], shape [3].
        radius: Length that torques are divided by, the object's largest distance from there [m].
    """
    forces = cone_edges(normals, friction=friction, edges=edges)
    torques = np.cross((points - center)[:, None], forces) / radius
    return np.concatenate([forces, torques], -1).reshape(-1, 6)


def wrench_space(wrenches: np.ndarray) -> WrenchSpace:
    """Epsilon and volume of the convex hull of wrenches, shape [n, 6]; both within 1e-8.

    Qhull joggles the wrenches by some 1e-11, so that flat arrangements (the eight edges of a cone lie in one plane)
    need no merging of facets: simpler, and twice as fast.
    """
    if len(wrenches) < 7:
        return WrenchSpace(0.0, 0.0)
    hull = ConvexHull(wrenches, qhull_options="QJ")
    epsilon = -float(hull.equations[:, 6].max())  # facets: normal . w + offset <= 0 inside
    return WrenchSpace(epsilon, float(hull.volume)) if epsilon > _EPSILON_ROUNDING else WrenchSpace(0.0, 0.0)


def wrench_spaces(
    points: np.ndarray, normals: np.ndarray, center: np.ndarray, radius: float, friction: float
) -> np.ndarray:
    """Epsilon and volume of several grasps of one object, shape [n, 2].

    Args:
        points: Contact points [m], shape [n, c, 3], NaN where there is no contact.
        normals: Normals into the object, shape [n, c, 3], NaN where there is no contact.
        center: The object's centre of mass [m], shape [3].
        radius: The object's largest distance from there [m].
    """
    out = np.zeros((len(points), 2))
    for i in range(len(points)):
        touches = np.isfinite(points[i]).all(-1)
        p, n = points[i, touches].astype(float), normals[i, touches].astype(float)
        n /= np.linalg.norm(n, axis=1, keepdims=True)
        out[i] = wrench_space(primitive_wrenches(p, n, center=center, radius=radius, friction=friction))
    return out

"""Collision solids of links: boxes, spheres, cylinders in closed form, meshes as they are."""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh

from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.meshes import FEATURE, PROBES, MeshDistance, surface_samples

try:
    import coal
except ModuleNotFoundError as error:
    raise JudgeError("the judge measures collisions between links with coal: pip install 'lgrasp[judge]'") from error

SAMPLES = 2_000
"""Sampled points of a solid, beside every vertex."""
DENT = 5e-4
"""A mesh whose hull is nowhere further from its surface counts as convex [m]."""

_EXIT_STEPS = 12  # along the way out of a link's solids


class JudgedSolid(ABC):
    """One collision solid in the frame of its link.

    Args:
        T: link from solid, shape [4, 4].
        points: of its surface, solid's frame, shape [S, 3].
        shape: the solid as coal takes it.
    """

    convex = True

    def __init__(self, link: int, T: np.ndarray, points: np.ndarray, shape: Any) -> None:
        self.link, self.T, self.shape = link, T, shape
        self.samples = points @ T[:3, :3].T + T[:3, 3]  # link's frame, as the centre
        self.centre = (points.min(axis=0) + points.max(axis=0)) / 2.0 @ T[:3, :3].T + T[:3, 3]
        self.radius = float(np.linalg.norm(self.samples - self.centre, axis=1).max())

    def local(self, points: np.ndarray) -> np.ndarray:
        return (points - self.T[:3, 3]) @ self.T[:3, :3]

    def depth(self, points: np.ndarray) -> np.ndarray:
        return np.maximum(-self.signed(points), 0.0)

    @abstractmethod
    def signed(self, points: np.ndarray) -> np.ndarray:
        """Signed distance (n,) of points (n, 3) in the link frame."""

    @abstractmethod
    def normals(self, points: np.ndarray) -> np.ndarray:
        """Admissible outward normals at the closest points, (n, P, 3), link frame; entry 0 is the nominal one."""


class PrimitiveSolid(JudgedSolid):
    """A solid that is a box in folded coordinates, of half extents ``size`` there."""

    def __init__(self, link: int, T: np.ndarray, size: np.ndarray) -> None:
        self.size = size
        super().__init__(link, T, *self._made())

    @abstractmethod
    def _made(self) -> tuple[np.ndarray, Any]:
        """Points of the surface, and the solid as coal takes it."""

    @abstractmethod
    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Folded coordinates (n, D) of points in the solid's frame, and their gradients (n, D, 3)."""

    def signed(self, points: np.ndarray) -> np.ndarray:
        d = self._fold(self.local(points))[0] - self.size
        return np.linalg.norm(np.maximum(d, 0.0), axis=1) + np.minimum(d.max(axis=1), 0.0)

    def normals(self, points: np.ndarray) -> np.ndarray:
        nominal = self._gradient(self.local(points))
        foot = self.local(points) - self.signed(points)[:, None] * nominal
        normals = self._gradient((foot[:, None] + PROBES).reshape(-1, 3)).reshape(len(points), len(PROBES), 3)
        normals[:, 0] = nominal
        return normals @ self.T[:3, :3].T

    def _gradient(self, p: np.ndarray) -> np.ndarray:
        folded, ways = self._fold(p)
        d = folded - self.size
        outside = np.maximum(d, 0.0)
        length = np.linalg.norm(outside, axis=1, keepdims=True)
        face = np.eye(len(self.size))[d.argmax(axis=1)]
        return np.einsum("nd,ndk->nk", np.where(length > 1e-9, outside / np.maximum(length, 1e-12), face), ways)


class BoxSolid(PrimitiveSolid):
    """A box; ``size`` holds its half extents."""

    def _made(self) -> tuple[np.ndarray, Any]:
        h = self.size
        step = math.sqrt(8.0 * (h[0] * h[1] + h[1] * h[2] + h[0] * h[2]) / SAMPLES)
        axes = [np.linspace(-k, k, max(2, math.ceil(2.0 * k / step) + 1)) for k in h]
        faces = [[*axes[:k], h[k] * np.array([-1.0, 1.0]), *axes[k + 1 :]] for k in range(3)]
        points = [np.stack(np.meshgrid(*face, indexing="ij"), axis=-1).reshape(-1, 3) for face in faces]
        return np.vstack(points), coal.Box(*(2.0 * h))

    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.abs(p), np.eye(3) * np.where(p < 0, -1.0, 1.0)[:, None]


class SphereSolid(PrimitiveSolid):
    """A ball; ``size`` holds its radius."""

    def _made(self) -> tuple[np.ndarray, Any]:
        i = np.arange(SAMPLES) + 0.5
        z, a = 1.0 - 2.0 * i / SAMPLES, i * math.pi * (3.0 - math.sqrt(5.0))
        r = np.sqrt(1.0 - z * z)
        return self.size[0] * np.column_stack([r * np.cos(a), r * np.sin(a), z]), coal.Sphere(float(self.size[0]))

    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.linalg.norm(p, axis=1, keepdims=True)
        return r, (p / np.maximum(r, 1e-12))[:, None]


class CylinderSolid(PrimitiveSolid):
    """A cylinder along z; ``size`` holds its radius and half its length."""

    def _made(self) -> tuple[np.ndarray, Any]:
        r, h = self.size
        step = math.sqrt((2.0 * math.pi * r * 2.0 * h + 2.0 * math.pi * r * r) / SAMPLES)
        rings = [(r, z, 12) for z in np.linspace(-h, h, max(2, math.ceil(2.0 * h / step) + 1))]
        rings += [(k, z, 1) for k in np.arange(0.0, r, step) for z in (-h, h)]
        points = []
        for k, z, least in rings:
            a = np.linspace(0.0, 2.0 * math.pi, max(least, math.ceil(2.0 * math.pi * k / step)), endpoint=False)
            points.append(np.column_stack([k * np.cos(a), k * np.sin(a), np.full(len(a), z)]))
        return np.vstack(points), coal.Cylinder(float(r), float(2.0 * h))

    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.linalg.norm(p[:, :2], axis=1)
        ways = np.zeros((len(p), 2, 3))
        ways[:, 0, :2] = p[:, :2] / np.maximum(r, 1e-12)[:, None]
        ways[:, 1, 2] = np.where(p[:, 2] < 0, -1.0, 1.0)
        return np.column_stack([r, np.abs(p[:, 2])]), ways


class MeshSolid(JudgedSolid):
    """A mesh as it is: its own surface for distances, its hull only for the convex test between links."""

    def __init__(self, link: int, T: np.ndarray, mesh: trimesh.Trimesh) -> None:
        self.surface, hull, corners = MeshDistance(mesh), mesh.convex_hull, coal.StdVec_Vec3s()
        corners.extend([np.asarray(p) for p in hull.vertices])
        super().__init__(link, T, surface_samples(mesh, SAMPLES), coal.Convex.convexHull(corners, False, None))
        self.convex = bool(self.surface.closest(surface_samples(hull, 2_000))[0].max() <= DENT)

    def signed(self, points: np.ndarray) -> np.ndarray:
        return self.surface.signed(self.local(points))

    def depth(self, points: np.ndarray) -> np.ndarray:
        return self.surface.depth(self.local(points))

    def normals(self, points: np.ndarray) -> np.ndarray:
        return self.surface.normals(self.local(points)) @ self.T[:3, :3].T


def mesh_solids(link: int, T: np.ndarray, mesh: trimesh.Trimesh) -> list[JudgedSolid]:
    """One solid per closed body; a mesh with open or inside-out bodies stays whole."""
    parts = mesh.split(only_watertight=False)
    with np.errstate(all="ignore"):  # parts without volume have no centre
        closed = len(parts) > 1 and all(p.is_watertight and p.volume > 0 for p in parts)
    if closed:
        return [MeshSolid(link, T, p) for p in parts]
    return [MeshSolid(link, T, mesh)]


def on_links(
    solids: Sequence[JudgedSolid], links: np.ndarray, points: np.ndarray, ways: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance to the union of the named link's solids and the admissible normals there (link frame).

    Inside of two solids the nearest face may be covered by the other one; admissible are then also the normals
    where the way into the object (n, 3) leaves the union, at most twice as far as its surface is.
    """
    distance, normals = _union(solids, links, points)
    more, inside = normals.copy(), np.flatnonzero(distance < 0)
    leave, depth = points[inside], -distance[inside]
    gone, end = np.zeros(len(inside)), FEATURE + 2.0 * depth
    for _ in range(_EXIT_STEPS):
        on = np.flatnonzero((depth > 0) & (gone <= end))
        gone[on] += np.maximum(depth[on], 1e-6)
        leave[on] = points[inside[on]] + ways[inside[on]] * np.minimum(gone[on], end[on])[:, None]
        depth[on] = -_union(solids, links[inside[on]], leave[on], with_normals=False)[0]
    out = (depth <= 1e-6) & (gone <= end)
    more[inside[out]] = _union(solids, links[inside[out]], leave[out])[1]
    return distance, np.concatenate([normals, more], axis=1)


def _union(
    solids: Sequence[JudgedSolid], links: np.ndarray, points: np.ndarray, *, with_normals: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance (n,), and admissible normals (n, P, 3) of the solid that is nearest, or deepest about."""
    distance = np.full(len(points), np.inf)
    normals = np.zeros((len(points), len(PROBES) + 1, 3))
    for solid in solids:
        m = np.flatnonzero(links == solid.link)
        signed = solid.signed(points[m])
        closer = signed < distance[m]
        m, signed = m[closer], signed[closer]
        distance[m] = signed
        if len(m) and with_normals:
            found = solid.normals(points[m])
            normals[m] = found[:, [*range(found.shape[1]), *[0] * (normals.shape[1] - found.shape[1])]]
    return distance, normals

"""Collision solids of links: boxes, spheres, cylinders in closed form, meshes as they are."""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import trimesh

from lgrasp.judge.bounds import JudgeError
from lgrasp.judge.meshes import PROBES, MeshDistance, surface_samples

try:
    import coal
except ModuleNotFoundError as error:
    raise JudgeError("the judge measures collisions between links with coal: pip install 'lgrasp[judge]'") from error

SAMPLES = 2_000
"""Sampled points of a solid, beside every vertex."""
DENT = 5e-4
"""A mesh whose hull is nowhere further from its surface counts as convex [m]."""


@dataclass
class JudgedSolid(ABC):
    """One collision solid in the frame of its link; concrete kinds fill in the distance."""

    link: int
    T: np.ndarray  # (4, 4), link from solid
    size: np.ndarray  # half extents | radius | radius, half length
    samples: np.ndarray = field(init=False)  # (S, 3), link frame
    centre: np.ndarray = field(init=False)  # (3,), link frame
    radius: float = field(init=False)
    convex: bool = True

    def __post_init__(self) -> None:
        local = self._samples()
        self.samples = local @ self.T[:3, :3].T + self.T[:3, 3]
        self.centre = (local.min(axis=0) + local.max(axis=0)) / 2.0 @ self.T[:3, :3].T + self.T[:3, 3]
        self.radius = float(np.linalg.norm(self.samples - self.centre, axis=1).max())
        self.shape = self._coal()

    def local(self, points: np.ndarray) -> np.ndarray:
        return (points - self.T[:3, 3]) @ self.T[:3, :3]

    def signed(self, points: np.ndarray) -> np.ndarray:
        """Signed distance of points (n, 3) in the link frame."""
        return self._signed(self.local(points))

    def depth(self, points: np.ndarray) -> np.ndarray:
        return np.maximum(-self.signed(points), 0.0)

    @abstractmethod
    def normals(self, points: np.ndarray) -> np.ndarray:
        """Admissible outward normals at the closest points, (n, P, 3), link frame; entry 0 is the nominal one."""

    @abstractmethod
    def _samples(self) -> np.ndarray:
        """Points of the surface (S, 3), solid's frame."""

    @abstractmethod
    def _coal(self) -> Any:
        """The solid as coal takes it."""

    @abstractmethod
    def _signed(self, p: np.ndarray) -> np.ndarray:
        """Signed distance of points (n, 3), solid's frame."""


class PrimitiveSolid(JudgedSolid):
    """A solid that is a box in folded coordinates."""

    def normals(self, points: np.ndarray) -> np.ndarray:
        p = self.local(points)
        nominal = self._gradient(p)
        foot = p - self._signed(p)[:, None] * nominal
        normals = self._gradient((foot[:, None] + PROBES).reshape(-1, 3)).reshape(len(points), len(PROBES), 3)
        normals[:, 0] = nominal
        return normals @ self.T[:3, :3].T

    @abstractmethod
    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Coordinates (n, D) of points in which the solid is a box of half extents ``size``, and their gradients."""

    def _signed(self, p: np.ndarray) -> np.ndarray:
        d = self._fold(p)[0] - self.size
        return np.linalg.norm(np.maximum(d, 0.0), axis=1) + np.minimum(d.max(axis=1), 0.0)

    def _gradient(self, p: np.ndarray) -> np.ndarray:
        folded, ways = self._fold(p)  # (n, D), (n, D, 3)
        d = folded - self.size
        outside = np.maximum(d, 0.0)
        length = np.linalg.norm(outside, axis=1, keepdims=True)
        face = np.eye(len(self.size))[d.argmax(axis=1)]
        return np.einsum("nd,ndk->nk", np.where(length > 1e-9, outside / np.maximum(length, 1e-12), face), ways)


class BoxSolid(PrimitiveSolid):
    def _samples(self) -> np.ndarray:
        h = self.size
        area = 8.0 * (h[0] * h[1] + h[1] * h[2] + h[0] * h[2])
        step = math.sqrt(area / SAMPLES)
        axes = [np.linspace(-k, k, max(2, math.ceil(2.0 * k / step) + 1)) for k in h]
        out = []
        for k in range(3):
            a, b = [axes[j] for j in range(3) if j != k]
            grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
            out += [np.insert(grid, k, s * h[k], axis=1) for s in (-1.0, 1.0)]
        return np.vstack(out)

    def _coal(self) -> Any:
        return coal.Box(*(2.0 * self.size))

    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return np.abs(p), np.eye(3) * np.where(p < 0, -1.0, 1.0)[:, None]


class SphereSolid(PrimitiveSolid):
    def _samples(self) -> np.ndarray:
        i = np.arange(SAMPLES) + 0.5
        z, a = 1.0 - 2.0 * i / SAMPLES, i * math.pi * (3.0 - math.sqrt(5.0))
        r = np.sqrt(1.0 - z * z)
        return self.size[0] * np.column_stack([r * np.cos(a), r * np.sin(a), z])

    def _coal(self) -> Any:
        return coal.Sphere(float(self.size[0]))

    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.linalg.norm(p, axis=1, keepdims=True)
        return r, (p / np.maximum(r, 1e-12))[:, None]


class CylinderSolid(PrimitiveSolid):
    def _samples(self) -> np.ndarray:
        r, h = self.size
        step = math.sqrt((2.0 * math.pi * r * 2.0 * h + 2.0 * math.pi * r * r) / SAMPLES)
        count = max(12, math.ceil(2.0 * math.pi * r / step))
        angle = np.arange(count) / count * 2.0 * math.pi
        ring = np.column_stack([np.cos(angle), np.sin(angle)])
        side = [np.insert(r * ring, 2, z, axis=1) for z in np.linspace(-h, h, max(2, math.ceil(2.0 * h / step) + 1))]
        caps = []
        for k in np.arange(0.0, r, step):
            n = max(1, math.ceil(2.0 * math.pi * k / step))
            a = np.arange(n) / n * 2.0 * math.pi
            disc = k * np.column_stack([np.cos(a), np.sin(a)])
            caps += [np.insert(disc, 2, z, axis=1) for z in (-h, h)]
        return np.vstack(side + caps)

    def _coal(self) -> Any:
        return coal.Cylinder(float(self.size[0]), float(2.0 * self.size[1]))

    def _fold(self, p: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        r = np.linalg.norm(p[:, :2], axis=1)
        ways = np.zeros((len(p), 2, 3))
        ways[:, 0, :2] = p[:, :2] / np.maximum(r, 1e-12)[:, None]
        ways[:, 1, 2] = np.where(p[:, 2] < 0, -1.0, 1.0)
        return np.column_stack([r, np.abs(p[:, 2])]), ways


class MeshSolid(JudgedSolid):
    """A mesh as it is: its own surface for distances, its hull only for the convex test between links."""

    def __init__(self, link: int, T: np.ndarray, mesh: trimesh.Trimesh) -> None:
        self.mesh, self.surface, self.hull = mesh, MeshDistance(mesh), mesh.convex_hull
        dents = self.surface.closest(surface_samples(self.hull, 2_000))[0]
        super().__init__(link, T, np.zeros(0))
        self.convex = bool(dents.max() <= DENT)

    def _samples(self) -> np.ndarray:
        return surface_samples(self.mesh, SAMPLES)

    def _coal(self) -> Any:
        points = coal.StdVec_Vec3s()
        for p in self.hull.vertices:
            points.append(np.asarray(p))
        return coal.Convex.convexHull(points, False, None)

    def _signed(self, p: np.ndarray) -> np.ndarray:
        return self.surface.signed(p)

    def depth(self, points: np.ndarray) -> np.ndarray:
        return self.surface.depth(self.local(points))

    def normals(self, points: np.ndarray) -> np.ndarray:
        return self.surface.normals(self.local(points)) @ self.T[:3, :3].T


def mesh_solids(link: int, T: np.ndarray, mesh: trimesh.Trimesh) -> list[JudgedSolid]:
    """One solid per closed body; a mesh with open or inside-out bodies stays whole."""
    parts = mesh.split(only_watertight=False)
    if len(parts) > 1 and all(p.is_watertight and p.volume > 0 for p in parts):
        return [MeshSolid(link, T, p) for p in parts]
    return [MeshSolid(link, T, mesh)]

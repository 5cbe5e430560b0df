"""Contact surfaces: where on its links a hand may touch, as points, normals and patches, and as link distance grids."""

from dataclasses import dataclass

import numpy as np
import trimesh

from lgrasp.hand.distance import signed_distance
from lgrasp.hand.spec import Cone, Surface

_GRID_CELL = 8.0e-4  # [m], more on large links
_GRID_PAD = 6.0e-3  # [m] of a grid beyond its link
_POINTS_PER_LINK = 600
_DRAWN_AREA = 1.0e-6  # [m^2] of a link's surface to a point drawn for a side, if that is _POINTS_DRAWN points
_POINTS_DRAWN = (4_800, 60_000)
_SIDE_AREA = 2.5e-6  # [m^2] of a side to a point that is kept, if that is _SIDE_POINTS points of a link
_SIDE_POINTS = (200, 2_400)
_PATCH_RADIUS = 0.010  # [m]
_PATCH_CONE = np.radians(36.0)  # [rad]


@dataclass(frozen=True)
class LinkGrid:
    """Signed distance grid of one link in its body frame."""

    values: np.ndarray  # (nx, ny, nz) f32 [m]
    origin: np.ndarray  # (3,) [m]
    cell: float


def link_grid(meshes: list[trimesh.Trimesh], device: str = "cpu") -> LinkGrid:
    """Distance grid of the union of a link's solids (already in the body frame)."""
    low = np.min([m.bounds[0] for m in meshes], 0) - _GRID_PAD
    high = np.max([m.bounds[1] for m in meshes], 0) + _GRID_PAD
    return box_grid(meshes, low, high, max(_GRID_CELL, float((high - low).max()) / 80), device)


def box_grid(
    meshes: list[trimesh.Trimesh],
    low: np.ndarray,
    high: np.ndarray,
    cell: float,
    device: str = "cpu",
    *,
    winding: bool = False,
) -> LinkGrid:
    """Distance grid of the union of a link's solids in a box with corners ``low`` and ``high`` (3,) [m]."""
    shape = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[a] + cell * np.arange(shape[a]) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    values = np.min([signed_distance(m, points, device, winding=winding) for m in meshes], 0)
    return LinkGrid(values.reshape(shape).astype(np.float32), low.astype(np.float32), cell)


def _in_cone(normals: np.ndarray, cone: Cone) -> np.ndarray:
    axis = np.asarray(cone.axis, float)
    return normals @ (axis / np.linalg.norm(axis)) > np.cos(np.radians(cone.angle))


def body_cones(cones: tuple[Cone, ...], T_body_link: np.ndarray) -> np.ndarray:
    """Cones of the link frame as rows (axis in the body frame, cosine), (n, 4)."""
    axes = [T_body_link[:3, :3] @ (np.array(c.axis) / np.linalg.norm(c.axis)) for c in cones]
    cosines = [np.cos(np.radians(c.angle)) for c in cones]
    return np.array([[*a, c] for a, c in zip(axes, cosines, strict=True)]).reshape(-1, 4)


def _sample(
    mesh: trimesh.Trimesh, rng: np.random.Generator, count: int = 8 * _POINTS_PER_LINK
) -> tuple[np.ndarray, np.ndarray]:
    points, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))[:2]
    return points, mesh.face_normals[faces]


def finger_points(
    meshes: list[trimesh.Trimesh],
    T_body_link: np.ndarray,
    forbidden: tuple[Cone, ...],
    rng: np.random.Generator,
    device: str = "cpu",
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) of a finger link's allowed surface, body frame.

    A point is dropped when its normal (link frame) is in a forbidden cone, or when other parts of the link stand in the
    way of an object there: of a finger-sized ball half-way, of a ball of 2 cm radius by 1 mm (recessed points).
    """
    points, normals = map(np.vstack, zip(*(_sample(m, rng) for m in meshes), strict=True))
    R = T_body_link[:3, :3]
    keep = np.ones(len(points), bool)
    for cone in forbidden:
        keep &= ~_in_cone(normals @ R, cone)
    keep &= _free(meshes, points, normals, ((1e-4, 0.0), (8e-3, 5e-3), (2e-2, 1.9e-2)), device)
    return _thin(points, normals, keep, rng)


def _free(
    meshes: list[trimesh.Trimesh],
    points: np.ndarray,
    normals: np.ndarray,
    probes: tuple[tuple[float, float], ...],
    device: str,
) -> np.ndarray:
    """(n,) bool: is every place ``probe`` [m] above a point farther than ``least`` [m] from a link's solids?"""
    free = np.ones(len(points), bool)
    for probe, least in probes:
        distance = np.min([signed_distance(m, points + probe * normals, device) for m in meshes], 0)
        free &= distance > least
    return free


def palm_points(
    meshes: list[trimesh.Trimesh],
    T_body_link: np.ndarray,
    allowed: tuple[Cone, ...],
    rng: np.random.Generator,
    device: str = "cpu",
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) of a static link's allowed surface, base frame."""
    points, normals = map(np.vstack, zip(*(_sample(m, rng) for m in meshes), strict=True))
    R = T_body_link[:3, :3]
    keep = np.zeros(len(points), bool)
    for cone in allowed:
        keep |= _in_cone(normals @ R, cone)
    keep &= _free(meshes, points, normals, ((1e-4, 0.0),), device)
    return _thin(points, normals, keep, rng)


def side_points(
    meshes: list[trimesh.Trimesh],
    around: list[trimesh.Trimesh],
    T_body_link: np.ndarray,
    surface: Surface,
    rng: np.random.Generator,
    device: str = "cpu",
) -> tuple[np.ndarray, np.ndarray, float]:
    """Points and normals (n, 3) of a link's part of one side of an opposition space, body frame, and its area [m^2].

    A point is dropped when the body is in the way of a finger-sized ball half-way, or of one of 2 cm radius by 2 mm.

    Args:
        meshes: solids of the link. around: those of all links on its body.
    """
    area = sum(float(m.area) for m in meshes)
    drawn = np.clip(area / _DRAWN_AREA, *_POINTS_DRAWN)
    shares = [max(1, round(drawn * float(m.area) / area)) for m in meshes]
    parts = [_sample(m, rng, count) for m, count in zip(meshes, shares, strict=True)]
    points, normals = map(np.vstack, zip(*parts, strict=True))
    R, t = T_body_link[:3, :3], T_body_link[:3, 3]
    keep = _in_cone(normals @ R, surface)
    if surface.box is not None:
        local = (points - t) @ R
        keep &= ((local >= surface.box.min) & (local <= surface.box.max)).all(1)
    points, normals = points[keep], normals[keep]
    keep = _free(around, points, normals, ((1e-4, 0.0), (8e-3, 5e-3), (2e-2, 1.8e-2)), device)
    kept = float(keep.sum() * area / sum(shares))
    return *_thin(points, normals, keep, rng, int(np.clip(kept / _SIDE_AREA, *_SIDE_POINTS))), kept


def _thin(
    points: np.ndarray, normals: np.ndarray, keep: np.ndarray, rng: np.random.Generator, most: int = _POINTS_PER_LINK
) -> tuple[np.ndarray, np.ndarray]:
    """At most ``most`` of the points to keep, in an order drawn for all: a point in doubt moves no other."""
    order = rng.permutation(len(points))
    chosen = order[keep[order]][:most]
    return points[chosen], normals[chosen]


def cover_patches(points: np.ndarray, normals: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Stochastic cover: patch index (n,) of each point; a patch reaches 10 mm and 36 degrees from its first point."""
    patch = np.full(len(points), -1, np.int32)
    for seed in rng.permutation(len(points)):
        if patch[seed] < 0:
            near = np.linalg.norm(points - points[seed], axis=1) < _PATCH_RADIUS
            near &= normals @ normals[seed] > np.cos(_PATCH_CONE)
            near[seed] = True
            patch[near & (patch < 0)] = patch.max() + 1
    return patch

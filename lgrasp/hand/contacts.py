"""Contact surfaces: where on its links a hand may touch, as points, normals and patches, and as link distance grids."""

from collections.abc import Sequence

import numpy as np
import trimesh

from lgrasp.hand.distance import signed_distance
from lgrasp.hand.model import csr
from lgrasp.hand.spec import Cone, Surface
from lgrasp.object.sdf import SdfGrid

_GRID_CELL = 8.0e-4  # [m], more on large links
_ROUNDING = 1e-6  # [m] of distances in single precision
_GRID_PAD = 6.0e-3  # [m] of a grid beyond its link
_POINTS_PER_LINK = 600
_DRAWN_AREA = 1.0e-6  # [m^2] of a link's surface to a point drawn for a side, if that is _POINTS_DRAWN points
_POINTS_DRAWN = (4_800, 60_000)
_SIDE_AREA = 2.5e-6  # [m^2] of a side to a point that is kept, if that is _SIDE_POINTS points of a link
_SIDE_POINTS = (200, 2_400)
_SURFACE = ((1e-4, 0.0),)  # places [m] above a point, and how far from all solids [m] each must be
_PATCH_RADIUS = 0.010  # [m]
_PATCH_CONE = np.radians(36.0)  # [rad]


def grid_arrays(grids: Sequence[SdfGrid], prefix: str = "") -> dict[str, np.ndarray]:
    """Arrays ``grid_*`` of a HandModel, their names after a prefix."""
    arrays = {
        "first": csr([grid.values.size for grid in grids]),
        "shape": np.array([grid.values.shape for grid in grids], np.int32).reshape(-1, 3),
        "origin": np.array([grid.origin for grid in grids], np.float32).reshape(-1, 3),
        "cell": np.array([grid.cell for grid in grids], np.float32),
        "values": np.concatenate([np.zeros(0, np.float32), *(grid.values.ravel() for grid in grids)]),
    }
    return {f"{prefix}grid_{name}": array for name, array in arrays.items()}


def link_grid(meshes: Sequence[trimesh.Trimesh]) -> SdfGrid:
    """Distance grid of the union of a link's solids (already in the body frame)."""
    low = np.min([m.bounds[0] for m in meshes], 0) - _GRID_PAD
    high = np.max([m.bounds[1] for m in meshes], 0) + _GRID_PAD
    return box_grid(meshes, low, high, max(_GRID_CELL, float((high - low).max()) / 80))


def box_grid(
    meshes: Sequence[trimesh.Trimesh], low: np.ndarray, high: np.ndarray, cell: float, **sign: bool
) -> SdfGrid:
    """Distance grid of the union of solids in a box with corners (3,) [m]; ``sign`` as of :func:`signed_distance`."""
    shape = np.ceil((high - low) / cell).astype(int) + 1
    axes = [low[a] + cell * np.arange(shape[a]) for a in range(3)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
    boxes, values = np.stack([_box_distance(mesh, points) for mesh in meshes]), np.full(len(points), np.inf, np.float32)
    nearest = boxes.argmin(0)
    for own in (True, False):  # of each point first the solid of the nearest box, then those that may be nearer
        for number, mesh in enumerate(meshes):
            rows = np.flatnonzero(((nearest == number) == own) & (boxes[number] <= values + _ROUNDING))
            values[rows] = np.minimum(values[rows], signed_distance(mesh, points[rows], **sign))
    return SdfGrid(values.reshape(shape), low.astype(np.float32), cell)


def in_cone(normals: np.ndarray, cone: Cone) -> np.ndarray:
    """(n,) bool: which normals (n, 3), link frame, are in a cone?"""
    axis = np.asarray(cone.axis, float)
    return normals @ (axis / np.linalg.norm(axis)) > np.cos(np.radians(cone.angle))


def body_cones(cones: tuple[Cone, ...], T_body_link: np.ndarray) -> np.ndarray:
    """Cones of the link frame as rows (axis in the body frame, cosine), (n, 4)."""
    axes = [T_body_link[:3, :3] @ (np.array(c.axis) / np.linalg.norm(c.axis)) for c in cones]
    return np.array([[*a, np.cos(np.radians(c.angle))] for a, c in zip(axes, cones, strict=True)]).reshape(-1, 4)


def link_points(
    meshes: Sequence[trimesh.Trimesh],
    T_body_link: np.ndarray,
    cones: tuple[Cone, ...],
    rng: np.random.Generator,
    *,
    palm: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) of a link's surface that may touch, body frame.

    A point of a finger is dropped when its normal is in one of the cones, or when other parts of the link stand in the
    way of an object there: of a finger-sized ball half-way, of a ball of 2 cm radius by 1 mm (recessed points). A point
    of a palm is kept when its normal is in one of the cones.
    """
    points, normals = _sample(meshes, [8 * _POINTS_PER_LINK] * len(meshes), rng)
    inside = np.zeros(len(points), bool)
    for cone in cones:
        inside |= in_cone(normals @ T_body_link[:3, :3], cone)
    free = _free(meshes, points, normals, _SURFACE if palm else (*_SURFACE, (8e-3, 5e-3), (2e-2, 1.9e-2)))
    return _thin(points, normals, free & (inside if palm else ~inside), rng)


def side_points(
    meshes: Sequence[trimesh.Trimesh],
    around: Sequence[trimesh.Trimesh],
    T_body_link: np.ndarray,
    surface: Surface,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, float]:
    """Points and normals (n, 3) of a link's part of one side of an opposition space, body frame, and its area [m^2].

    A point is dropped when the body is in the way of a finger-sized ball half-way, or of one of 2 cm radius by 2 mm.

    Args:
        meshes: solids of the link. around: those of all links on its body.
    """
    area = sum(float(m.area) for m in meshes)
    drawn = np.clip(area / _DRAWN_AREA, *_POINTS_DRAWN)
    shares = [max(1, round(drawn * float(m.area) / area)) for m in meshes]
    points, normals = _sample(meshes, shares, rng)
    R, t = T_body_link[:3, :3], T_body_link[:3, 3]
    keep = in_cone(normals @ R, surface)
    if surface.box is not None:
        local = (points - t) @ R
        keep &= ((local >= surface.box.min) & (local <= surface.box.max)).all(1)
    points, normals = points[keep], normals[keep]
    keep = _free(around, points, normals, (*_SURFACE, (8e-3, 5e-3), (2e-2, 1.8e-2)))
    kept = float(keep.sum() * area / sum(shares))
    return *_thin(points, normals, keep, rng, int(np.clip(kept / _SIDE_AREA, *_SIDE_POINTS))), kept


def _sample(
    meshes: Sequence[trimesh.Trimesh], counts: Sequence[int], rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (n, 3) of meshes, of each as many as ``counts`` says."""
    points, normals = [], []
    for mesh, count in zip(meshes, counts, strict=True):
        found, faces = trimesh.sample.sample_surface(mesh, count, seed=int(rng.integers(2**31)))[:2]
        points.append(found)
        normals.append(mesh.face_normals[faces])
    return np.vstack(points), np.vstack(normals)


def _free(
    meshes: Sequence[trimesh.Trimesh],
    points: np.ndarray,
    normals: np.ndarray,
    probes: tuple[tuple[float, float], ...],
) -> np.ndarray:
    """(n,) bool: is every place ``probe`` [m] above a point farther than ``least`` [m] from a link's solids?"""
    free = np.ones(len(points), bool)
    for probe, least in probes:
        places = points + probe * normals
        for mesh in meshes:
            near = np.flatnonzero(free & (_box_distance(mesh, places) <= least + _ROUNDING))
            free[near] = signed_distance(mesh, places[near]) > least
    return free


def _box_distance(mesh: trimesh.Trimesh, points: np.ndarray) -> np.ndarray:
    """(n,) [m]: no point (n, 3) is nearer than this to a mesh, by the box around it; negative inside the box."""
    low, high = mesh.bounds
    x, y, z = np.maximum(low - points, points - high).T
    return np.maximum(np.maximum(x, y), z)


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

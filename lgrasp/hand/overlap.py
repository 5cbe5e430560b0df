"""Link pairs whose pieces touch in nearly every posture although their true surfaces may not: samples and grids.

Knuckles sit in sockets of the palm. Hulls of both touch always, and so do the meshes themselves where they are drawn
with less play than the real parts have. Such a pair may overlap by :data:`OVERLAP`, measured on the true surfaces:
samples of each link in a distance grid of the other. A pair that touches in every posture is left alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from lgrasp.geometry.clusters import one_per_cell
from lgrasp.hand.contacts import box_grid, grid_arrays
from lgrasp.hand.model import csr, stack_rows
from lgrasp.hand.self_collision import OVERLAP
from lgrasp.object.sdf import SdfGrid

_POINT_SPACING = 8.0e-4  # [m]
_MAX_POINTS = 20_000
_MIN_CELL = 6.0e-4  # [m]
_MAX_CELLS = 300_000
_GRID_PAD = 3.0e-3  # [m]
_MIN_DEPTH = 3.0e-4  # [m] points that never get deeper than this are not kept


@dataclass(frozen=True)
class OverlapSide:
    """Points of one link that enter another link, and that link's distance grid."""

    body: int  # of the points
    grid_body: int
    points: np.ndarray  # (n, 3) [m], body frame, those that are deepest most often first
    grid: SdfGrid
    depth: np.ndarray  # (N,) [m] deepest point at each posture, 0 when apart


def _surface(meshes: Sequence[trimesh.Trimesh]) -> np.ndarray:
    """Points (n, 3) of a link's surface about _POINT_SPACING apart, vertices included."""
    parts = [np.asarray(m.vertices, float) for m in meshes]
    for mesh in meshes:
        count = int(np.clip(4 * mesh.area / _POINT_SPACING**2, 64, 8 * _MAX_POINTS))
        parts.append(trimesh.sample.sample_surface(mesh, count, seed=0)[0])
    points = np.vstack(parts)
    return points[one_per_cell(points, _POINT_SPACING)][:_MAX_POINTS]


def _lookup(grid: SdfGrid, p: np.ndarray) -> np.ndarray:
    """Signed distances of points (..., 3) by trilinear interpolation; far (1 m) beyond the grid."""
    from scipy.ndimage import map_coordinates

    x = (p - grid.origin) / grid.cell
    value = map_coordinates(grid.values, x.reshape(-1, 3).T, order=1, mode="constant", cval=1.0)
    return value.reshape(x.shape[:-1])


def _side(
    body: int,
    grid_body: int,
    meshes: Sequence[trimesh.Trimesh],
    grid_meshes: Sequence[trimesh.Trimesh],
    T: np.ndarray,
) -> OverlapSide | None:
    """Points of ``meshes`` against a grid of ``grid_meshes``; T (N, 4, 4) takes the points' body to the grid's."""
    points = _surface(meshes)
    low, high = np.min([m.bounds[0] for m in grid_meshes], 0), np.max([m.bounds[1] for m in grid_meshes], 0)
    near = np.zeros(len(points), bool)
    box_low, box_high = high.copy(), low.copy()
    for M in T:
        p = points @ M[:3, :3].T + M[:3, 3]
        inside = ((p > low) & (p < high)).all(1)
        if inside.any():
            near |= inside
            box_low, box_high = np.minimum(box_low, p[inside].min(0)), np.maximum(box_high, p[inside].max(0))
    if not near.any():
        return None
    points = points[near]
    box_low, box_high = box_low - _GRID_PAD, box_high + _GRID_PAD
    cell = max(_MIN_CELL, float(np.prod(box_high - box_low) / _MAX_CELLS) ** (1 / 3))
    holes = not all(m.is_watertight for m in grid_meshes)
    grid = box_grid(list(grid_meshes), box_low, box_high, cell, winding=holes)
    depth, often, deepest = np.zeros(len(T)), np.zeros(len(points)), np.zeros(len(points))
    for i, M in enumerate(T):
        sunk = np.maximum(0.0, -_lookup(grid, points @ M[:3, :3].T + M[:3, 3]))
        depth[i] = sunk.max()
        often += sunk > OVERLAP
        deepest = np.maximum(deepest, sunk)
    order = np.argsort(-often, kind="stable")
    return OverlapSide(body, grid_body, points[order[deepest[order] > _MIN_DEPTH]], grid, depth)


def overlap_sides(
    bodies: tuple[int, int],
    meshes: tuple[Sequence[trimesh.Trimesh], Sequence[trimesh.Trimesh]],
    T_base: tuple[np.ndarray, np.ndarray],
) -> list[OverlapSide]:
    """Both sides of a link pair, those without a point that sinks in left out.

    Args:
        bodies: of the two links.
        meshes: their solids, body frames.
        T_base: (N, 4, 4) poses of the two bodies at N postures.
    """
    T_ab = np.linalg.inv(T_base[0]) @ T_base[1]  # b in a
    found = [
        _side(bodies[1], bodies[0], meshes[1], meshes[0], T_ab),
        _side(bodies[0], bodies[1], meshes[0], meshes[1], np.linalg.inv(T_ab)),
    ]
    return [side for side in found if side is not None and len(side.points)]


def overlap_depth(
    sides: Sequence[OverlapSide], bodies: tuple[int, int], T_base: tuple[np.ndarray, np.ndarray]
) -> np.ndarray:
    """Depth (N,) [m] to which two links overlap by the points of their sides, 0 when apart.

    Args:
        bodies, T_base: as for :func:`overlap_sides`.
    """
    depth = np.zeros(len(T_base[0]))
    pose = dict(zip(bodies, T_base, strict=True))
    for side in sides:
        T = np.linalg.inv(pose[side.grid_body]) @ pose[side.body]
        for rows in np.array_split(np.arange(len(T)), max(1, len(T) * len(side.points) // 2_000_000)):
            p = side.points @ T[rows, :3, :3].transpose(0, 2, 1) + T[rows, None, :3, 3]
            depth[rows] = np.maximum(depth[rows], -_lookup(side.grid, p).min(1))
    return depth


def overlap_arrays(sides: Sequence[OverlapSide], key: Sequence[int], keys: int) -> dict[str, np.ndarray]:
    """The ``overlap_*`` arrays of a HandModel; ``key`` is the group pair of each side, of ``keys``."""
    chosen = [sides[i] for i in np.argsort(np.asarray(key, int), kind="stable")]
    ends = np.cumsum([0, *(len(s.points) for s in chosen)])
    rows = [(s.body, s.grid_body, ends[i], ends[i + 1]) for i, s in enumerate(chosen)]
    return {
        "overlap_first": csr(np.bincount(np.asarray(key, int), minlength=keys)),
        "overlap_sides": np.array(rows, np.int32).reshape(-1, 4),
        "overlap_points": stack_rows([s.points for s in chosen], 3),
        **grid_arrays([s.grid for s in chosen], "overlap_"),
    }

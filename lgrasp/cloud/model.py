"""Point clouds as objects: models without faces that all else takes for an object."""

import hashlib
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from lgrasp.errors import ObjectError
from lgrasp.geometry.clusters import CLUSTER_SIZE, bounding_spheres, cluster_order
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.object.surface import opposite_points, probe_fits
from lgrasp.runtime.cores import cores
from lgrasp.runtime.ordered import in_order

TRUST = 0.02
"""Behind what was seen, the sign of distances is known to this depth [m]; what lies deeper counts as neither."""

_LEAST_POINTS, _MOST_POINTS = 32, 8192
_EXTENT = (0.005, 2.0)  # [m]
_NEIGHBOURS, _LEAST_WIDE, _WIDE = 24, 48, 128
_CLEAN = 0.001  # [m]
_PLANES, _EDGE = 12, 0.5  # points that tell a distance; cosine of faces that meet in an edge
_PASSES, _KEPT = 4, 0.95  # over noisy clouds
_SAME_SIDE = 0.7  # cosine
_PAD = 0.016
_MOST_NODES, _LEAST_CELL = 250_000, 0.0015
_NODES_AT_ONCE = 4096
_CONTACTS = 4096
_TRUSTED, _GUESSED = 0.003, 0.009  # [m] from what was seen: its distances hold; they are guessed
_BOX = (0.01, 0.99)  # shares of the points along an axis
_FOLD_POINTS, _SMOOTH = 6, 0.85  # points whose normals tell a fold; their least cosine where there is none


def cloud_object(points: np.ndarray, normals: np.ndarray, *, name: str = "cloud", centred: bool = True) -> ObjectModel:
    """An ObjectModel without faces from points of a surface, perhaps of one side only.

    Distances are those to planes through the nearest points, so that noise averages out; inside they are negative to
    the depth TRUST, and positive beyond: what nobody saw is no obstacle, and nothing to touch either. The centre of
    mass is the mean of the points.

    Args:
        points: (n, 3) [m]. normals: outward, (n, 3).
        centred: else the internal frame is that of the points.

    Raises:
        ObjectError: too few points, not finite, a size that no hand grasps, normals that do not match.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ObjectError(f"cloud '{name}': points of shape {list(points.shape)}; need [n, 3]")
    bad = int((~np.isfinite(points).all(1)).sum())
    if bad:
        raise ObjectError(f"cloud '{name}': {bad} of {len(points)} points are NaN or infinite; drop them first")
    if len(points) < _LEAST_POINTS:
        raise ObjectError(f"cloud '{name}' has {len(points)} points; at least {_LEAST_POINTS} are needed")
    size, (least, most) = float(np.ptp(points, axis=0).max()), _EXTENT
    if not least <= size <= most:
        told = f"cloud '{name}' is {size:.3g} m long; accepted: {least:g} to {most:g} m (are its units metres?)"
        raise ObjectError(told)
    digest = hashlib.sha256(np.ascontiguousarray(points).tobytes())
    keep = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
    normals = np.asarray(normals, float)
    length = np.linalg.norm(normals, axis=-1, keepdims=True)
    if normals.shape != points.shape or not (np.isfinite(length) & (length > 1e-6)).all():
        raise ObjectError(f"cloud '{name}': normals must be {len(points)} finite vectors that are not zero")
    digest.update(np.ascontiguousarray(normals).tobytes())
    points, normals = points[keep], (normals / length)[keep]
    center = 0.5 * (points.min(0) + points.max(0)) if centred else np.zeros(3)
    points = points - center
    points, normals = _smoothed(points, normals)
    note = "a point cloud: what was not seen of the object is unknown"
    return _model(name, digest.hexdigest(), center, points, normals, _distances(points, normals), points.mean(0), note)


def completed_object(
    seen: ObjectModel, distance: Callable[[np.ndarray], np.ndarray], inside: np.ndarray
) -> ObjectModel:
    """The model of a cloud with the sides that nobody saw, as somebody guesses them; in the cloud's internal frame.

    Distances near what was seen stay, farther off they are those guessed.

    Args:
        seen: what :func:`cloud_object` gave.
        distance: signed distances [m] guessed at places (n, 3) of the internal frame, (n,).
        inside: places all over the inside, a few millimetres apart [m], (k, 3).
    """
    points, normals = seen.obstacle_points.astype(float), seen.obstacle_normals.astype(float)
    points, kept = np.unique(points, axis=0, return_index=True)
    normals, tree = normals[kept], cKDTree(points)
    whole = np.concatenate([points, inside])
    nodes, shape, cell = _lattice(whole.min(0) - _PAD, whole.max(0) + _PAD)
    value, away = distance(nodes), tree.query(nodes, distance_upper_bound=_GUESSED, workers=-1)[0]
    near = away < _GUESSED
    share = np.clip((_GUESSED - away[near]) / (_GUESSED - _TRUSTED), 0, 1)
    value[near] = share * _heights(nodes[near], points, normals, tree, cell)[0] + (1 - share) * value[near]
    grid = value.reshape(shape)
    hidden = (np.abs(value) < cell) & (away > _GUESSED)
    slope = np.stack(np.gradient(grid, cell), -1).reshape(-1, 3)[hidden]
    slope /= np.linalg.norm(slope, axis=1, keepdims=True).clip(1e-9)
    points = np.concatenate([points, nodes[hidden] - value[hidden, None] * slope])
    order = np.random.default_rng(0).permutation(len(points))[:_MOST_POINTS]
    within = nodes[value < 0]
    com = within.mean(0) if len(within) else seen.com
    made = grid.astype(np.float32), nodes[0].astype(np.float32), cell
    note = "a point cloud: what was not seen of the object is guessed"
    digest = hashlib.sha256(made[0].tobytes()).hexdigest()
    normals = np.concatenate([normals, slope])
    return _model(seen.name, digest, seen.center.astype(float), points[order], normals[order], made, com, note)


def searched_object(whole: ObjectModel, params: ObjectParams) -> ObjectModel:
    """The model of a whole object as pipelines search it: about the middle of its box (but for stray points), contact
    points away from hollows and folds, in order, and what is opposite to each.

    Args:
        whole: what :func:`completed_object` gave. params: of contact points.

    Raises:
        ObjectError: no two contact points are opposite to each other.
    """
    points, kept = np.unique(whole.obstacle_points, axis=0, return_index=True)
    points, normals = points.astype(float), whole.obstacle_normals[kept].astype(float)
    sdf, middle = whole.grid, np.quantile(points, _BOX, axis=0).mean(0)
    fits = probe_fits(sdf, points, normals, params.probe_radius, params.probe_tolerance)
    near = cKDTree(points).query(points, min(_FOLD_POINTS, len(points)), workers=-1)[1]
    cosine = np.einsum("nki,ni->nk", normals[near], normals).min(1)
    for chosen in (fits & (cosine > _SMOOTH), fits, np.ones_like(fits)):
        if chosen.sum() >= params.min_contact_fraction * len(points):
            break
    touched = np.flatnonzero(chosen)
    touched = np.random.default_rng(params.seed).permutation(touched)[: params.contact_count]
    touched = touched[cluster_order(points[touched])]
    contacts, outward = (x[touched].astype(np.float32) for x in (points - middle, normals))
    opposite = opposite_points(contacts, outward, seed=params.seed)
    if (opposite < 0).all():
        raise ObjectError(f"cloud '{whole.name}' shows no two sides to press on; add views of its other sides")
    moved = ("com", "sdf_origin", "obstacle_points", "cluster_center")
    return replace(
        whole,
        **{name: (getattr(whole, name) - middle).astype(np.float32) for name in moved},
        center=(whole.center + middle).astype(np.float32),
        contact_points=contacts,
        contact_normals=outward,
        contact_opposite=opposite,
    )


def _model(
    name: str,
    digest: str,
    center: np.ndarray,
    points: np.ndarray,
    normals: np.ndarray,
    grid: tuple[np.ndarray, np.ndarray, float],
    com: np.ndarray,
    note: str,
) -> ObjectModel:
    """Of points in the internal frame, without faces."""
    order = cluster_order(np.resize(points, (-(-len(points) // CLUSTER_SIZE) * CLUSTER_SIZE, 3))) % len(points)
    obstacles = points[order].astype(np.float32)
    balls = bounding_spheres(obstacles)
    sdf, origin, cell = grid
    return ObjectModel(
        name=name,
        sha256=digest,
        scale=1.0,
        center=center.astype(np.float32),
        vertices=(points + center).astype(np.float32),
        faces=np.zeros((0, 3), np.int32),
        watertight=False,
        com=com.astype(np.float32),
        extents=np.ptp(points, axis=0).astype(np.float32),
        notes=[note],
        contact_points=points[:_CONTACTS].astype(np.float32),
        contact_normals=normals[:_CONTACTS].astype(np.float32),
        contact_opposite=np.full(len(points[:_CONTACTS]), -1, np.int32),
        obstacle_points=obstacles,
        obstacle_normals=normals[order].astype(np.float32),
        cluster_center=balls[0],
        cluster_radius=balls[1],
        sdf=sdf,
        sdf_origin=origin,
        sdf_cell=cell,
    )


def _smoothed(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points moved onto the surface through their neighbours that face the same way, and its normals.

    A cloud whose points lie a millimetre or more off the surface through a wide neighbourhood is taken for noisy: it
    is smoothed over such neighbourhoods again and again, and what stays apart, or is sparse, is dropped.
    """
    wide = min(_WIDE, len(points))
    gap, near = cKDTree(points).query(points, wide, workers=-1)
    noise = 1.5 * float(np.median(np.abs(_fit(points, normals, near)[0])))
    if noise < _CLEAN:
        height, normal = _fit(points, normals, near[:, :_NEIGHBOURS])
        return points + height[:, None] * normal, normal
    # neighbourhoods that reach four times the noise
    wide = int(np.clip((np.median(gap, axis=0) < 4 * noise).sum(), min(_LEAST_WIDE, wide), wide))
    near = near[:, :wide]
    height, normal = _fit(points, normals, near)
    for _ in range(_PASSES):
        points, normals = points + height[:, None] * normal, normal
        near = cKDTree(points).query(points, wide, workers=-1)[1]
        height, normal = _fit(points, normals, near)
    # noise along the surface carries points past its edges, where they are half as dense
    gap = np.linalg.norm(points[near] - points[:, None], axis=2)
    same = np.cumsum(np.einsum("nki,ni->nk", normals[near], normals) > _SAME_SIDE, axis=1)
    reach = np.where(same >= wide // 2, gap, np.inf).min(1)
    keep = (np.abs(height) <= np.quantile(np.abs(height), _KEPT)) & (reach <= np.sqrt(2) * np.median(reach))
    return points[keep], normals[keep]


def _fit(points: np.ndarray, normals: np.ndarray, near: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How far above each point the surface through its neighbours (n, k) of the same side runs [m], (n,), and its
    normals: a quadratic function over the plane of the mean normal."""
    same = (np.einsum("nki,ni->nk", normals[near], normals) > _SAME_SIDE).astype(float)
    normal = np.einsum("nk,nki->ni", same, normals[near])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    u = np.cross(normal, np.eye(3)[np.abs(normal).argmin(1)])
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(normal, u)
    way = points[near] - points[:, None]
    x, y, z = (np.einsum("nki,ni->nk", way, axis) for axis in (u, v, normal))
    reach = np.sqrt((same * (x * x + y * y)).sum(1) / same.sum(1))[:, None] + 1e-9
    x, y = x / reach, y / reach
    A = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], -1)  # (n, k, 6)
    lhs = np.einsum("nk,nki,nkj->nij", same, A, A) + 1e-3 * same.sum(1)[:, None, None] * np.eye(6)
    c = np.linalg.solve(lhs, np.einsum("nk,nki,nk->ni", same, A, z)[..., None])[..., 0]
    tilted = normal - (c[:, 1:2] * u + c[:, 2:3] * v) / reach
    return c[:, 0], tilted / np.linalg.norm(tilted, axis=1, keepdims=True)


def _distances(points: np.ndarray, normals: np.ndarray) -> tuple[np.ndarray, np.ndarray, float]:
    """Signed distance grid [m] of planes through points, its origin and its cell."""
    nodes, shape, cell = _lattice(points.min(0) - _PAD, points.max(0) + _PAD)
    value, away = _heights(nodes, points, normals, cKDTree(points), cell)
    value = np.where((value < 0) & (away > TRUST), away, value)
    return value.reshape(shape).astype(np.float32), nodes[0].astype(np.float32), cell


def _lattice(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, tuple[int, ...], float]:
    """Nodes of a grid over a box [m], (n, 3), their number along each axis, and the cell [m]."""
    cell = max(_LEAST_CELL, float(np.prod(high - low) / _MOST_NODES) ** (1 / 3))
    shape = tuple((np.ceil((high - low) / cell).astype(int) + 1).tolist())
    return low + cell * np.indices(shape).reshape(3, -1).T, shape, cell


def _heights(
    nodes: np.ndarray, points: np.ndarray, normals: np.ndarray, tree: cKDTree, cell: float
) -> tuple[np.ndarray, np.ndarray]:
    """Signed distances of nodes from planes through points, however deep, and distances from the nearest point [m]."""
    height = np.einsum("ni,ni->n", points, normals)
    spacing = float(np.median(tree.query(points, 2, workers=-1)[0][:, 1]))

    def part(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        gap, near = tree.query(nodes, min(_PLANES, len(points)))
        weight = np.exp(-0.5 * (gap / (gap[:, :1] + cell)) ** 2)
        facing = normals[near]
        above = np.einsum("nki,ni->nk", facing, nodes) - height[near]
        plane = (weight * above).sum(1) / weight.sum(1)
        # about an edge what is outside one of its faces is outside
        edge = np.einsum("nki,ni->nk", facing, facing[:, 0]).min(1) < _EDGE
        plane = np.where(edge, above.max(1), plane)
        # close to the surface the planes tell the distance, farther off the nearest point does
        share = np.clip(gap[:, 0] / max(4 * spacing, 2 * cell) - 0.5, 0, 1)
        return (1 - share) * plane + share * np.sign(plane) * gap[:, 0], gap[:, 0]

    cuts = [nodes[at : at + _NODES_AT_ONCE] for at in range(0, len(nodes), _NODES_AT_ONCE)]
    distance, away = zip(*(found for _, found in in_order(part, cuts, cores())), strict=True)
    return np.concatenate(distance), np.concatenate(away)

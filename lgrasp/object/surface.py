"""Points on an object's surface: contact candidates with their masks, and obstacle points."""

import numpy as np
import warp as wp
from scipy import ndimage
from scipy.spatial import KDTree

from lgrasp.geometry.edges import face_neighbours, face_normals
from lgrasp.object.sdf import SdfGrid, sample_sdf
from lgrasp.runtime.fetch import to_numpy

from . import kernels

_OPPOSED = float(np.cos(np.radians(30.0)))  # of the line between two opposite points to their normals, at least
_OVERSAMPLE = 5  # candidates for one point kept
_WALK_FACES = 256  # faces visited around a point in the fold test


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int, *, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Stratified area-weighted points in random order.

    Returns:
        Points [m], shape (n, 3), f64, and their faces, shape (n,), int32; n = ``count`` times an oversampling factor,
        to be reduced by :func:`thin`.
    """
    rng = np.random.default_rng(seed)
    total = count * _OVERSAMPLE
    filled = np.cumsum(face_normals(vertices, faces)[1])
    at = (np.arange(total) + rng.random(total)) / total * filled[-1]
    face = np.minimum(np.searchsorted(filled, at, side="right"), len(faces) - 1)
    u, v = rng.random((2, total))
    u = np.sqrt(u)
    weights = np.stack([1.0 - u, u * (1.0 - v), u * v], axis=1)  # (n, 3)
    points = np.einsum("nk,nkd->nd", weights, vertices[faces[face]])
    order = rng.permutation(total)
    return points[order], face[order].astype(np.int32)


def thin(points: np.ndarray, count: int, area: float) -> np.ndarray:
    """Exactly ``count`` evenly spread points: maximal Poisson-disk sets of falling radius, earlier points preferred.

    Args:
        points: Candidates in order of preference [m], shape (n, 3), n >= ``count``.
        count: Points to keep.
        area: Surface area [m²], sets the first radius.

    Returns:
        Indices of the points kept, shape (count,), coarse to fine.
    """
    kept = np.zeros(0, np.int64)
    left = np.arange(len(points))
    radius = 0.9 * float(np.sqrt(area / count))
    while len(kept) < count:
        if len(kept):
            left = left[KDTree(points[kept]).query(points[left], distance_upper_bound=radius)[0] >= radius]
        chosen = left[_independent(KDTree(points[left]).query_pairs(radius, output_type="ndarray"), len(left))]
        kept = np.concatenate([kept, chosen[: count - len(kept)]])
        left = np.setdiff1d(np.arange(len(points)), kept, assume_unique=True)
        radius *= 0.8 if radius > 1e-7 else 0.0
    return kept


def _independent(pairs: np.ndarray, count: int) -> np.ndarray:
    """Greedy maximal independent set in index order: flags, shape (count,), no two of a pair both set."""
    low, high = pairs.min(axis=1), pairs.max(axis=1)
    state = np.zeros(count, np.int8)  # 1 in, -1 out
    while len(low):
        blocked = np.zeros(count, bool)
        blocked[high] = True  # waits for an undecided point of smaller index
        state[(state == 0) & ~blocked] = 1
        state[high[state[low] == 1]] = -1
        open_pair = (state[low] == 0) & (state[high] == 0)
        low, high = low[open_pair], high[open_pair]
    return state >= 0


def fold_cosine(
    vertices: np.ndarray,
    faces: np.ndarray,
    points: np.ndarray,
    point_face: np.ndarray,
    radius: float,
) -> np.ndarray:
    """Smallest cosine between a point's face normal and those reached over the surface within ``radius`` [m].

    Args:
        points: Points on the surface [m], shape (n, 3).
        point_face: Their faces, shape (n,).

    Returns:
        Cosines, shape (n,), f32; -1 beside an open edge. Small values mean a fold, an edge or scan noise.
    """
    normals, _ = face_normals(vertices, faces)
    out = wp.empty(len(points), dtype=float, device="cpu")
    inputs = [
        wp.array(vertices[faces], dtype=wp.vec3, device="cpu"),
        wp.array(face_neighbours(faces), dtype=wp.int32, device="cpu"),
        wp.array(points, dtype=wp.vec3, device="cpu"),
        wp.array(normals[point_face], dtype=wp.vec3, device="cpu"),
        wp.array(point_face, dtype=wp.int32, device="cpu"),
        radius,
        wp.empty((len(points), min(_WALK_FACES, len(faces))), dtype=wp.int32, device="cpu"),
    ]
    wp.launch(kernels.fold_spread, len(points), inputs, [out], device="cpu")
    return to_numpy(out)


def opposite_points(points: np.ndarray, normals: np.ndarray, *, seed: int) -> np.ndarray:
    """For each point a random one that a finger and an opposed finger could press together with it.

    Both normals are within 30 degrees of the line between the two; cavities in between do not matter.

    Args:
        points: On the surface [m], shape (n, 3).
        normals: Outward unit normals, shape (n, 3).

    Returns:
        Indices, shape (n,), int32; -1 where there is none.
    """
    out = wp.empty(len(points), dtype=wp.int32, device="cpu")
    surface = [wp.array(values, dtype=wp.vec3, device="cpu") for values in (points, normals)]
    wp.launch(kernels.draw_opposite, len(points), [*surface, _OPPOSED, seed], [out], device="cpu")
    return to_numpy(out)


def probe_fits(sdf: SdfGrid, points: np.ndarray, normals: np.ndarray, radius: float, tolerance: float) -> np.ndarray:
    """Whether a ball of ``radius`` [m] can rest on each point from outside and get there.

    The ball touching the point may sink into the object by ``tolerance`` [m] at most; it has no shaft, so whatever
    stands farther away along the normal (the other wall of a mug) does not count. Its centre must be connected to the
    outside of the grid, so the walls of closed cavities fail.

    Returns:
        Flags, shape (n,).
    """
    centre = points + radius * normals
    fits = sample_sdf(sdf, centre) >= radius - tolerance
    coarse = sdf.values[::2, ::2, ::2] >= radius - tolerance - 2.0 * sdf.cell
    label = np.zeros(coarse.shape, np.int32)
    ndimage.label(coarse, output=label)
    border = np.ones(label.shape, bool)
    border[1:-1, 1:-1, 1:-1] = False
    outside = np.isin(label, np.unique(label[border & coarse]))
    at = np.rint((centre - sdf.origin) / (2.0 * sdf.cell)).astype(int)
    return fits & outside[tuple(np.clip(at, 0, np.array(label.shape) - 1).T)]

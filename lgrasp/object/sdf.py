"""Signed distance grid of a mesh: exact near the surface, propagated from there outward."""

from dataclasses import dataclass

import numpy as np
import warp as wp
from scipy import ndimage

from lgrasp.runtime.fetch import to_numpy

from . import kernels

_BAND_CELLS = 2.0  # half width of the exact band; sqrt(3) is the least that leaves no gap between its two sides
_SPLIT_CELLS = 8.0  # longer triangles are cut before they are offered to the cells of their bounding box
_LATTICE_SHIFT = (1.9e-5, 2.7e-5, 0.0)  # in cells: keeps columns off vertices and edges that sit on round coordinates


@dataclass(frozen=True)
class SdfGrid:
    """Signed distances at the nodes of a regular grid, negative inside.

    Attributes:
        values: Distances [m], shape (nx, ny, nz), f32; ``values[i, j, k]`` is at ``origin + cell * (i, j, k)``.
        origin: Position of the first node [m], shape (3,), f32.
        cell: Node spacing [m].
    """

    values: np.ndarray
    origin: np.ndarray
    cell: float


def build_sdf(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    closed: bool,
    max_cells: int,
    min_cell: float = 0.0005,
    pad: float = 0.008,
) -> SdfGrid:
    """Signed distance grid of a triangle mesh.

    Distances are exact within two cells of the surface (every triangle visits the cells near it); a cell farther out
    takes the face of its nearest band cell. The sign of a closed mesh is its integer winding number, counted along
    columns of cells, so bodies may overlap; that of an open mesh is the generalised winding number in the band.

    Args:
        vertices: Vertices [m], shape (v, 3), f64.
        faces: Vertex indices, outward winding, shape (f, 3), int32.
        closed: Whether every directed edge is matched by its opposite.
        max_cells: Upper bound of the number of nodes.
        min_cell: Lower bound of the spacing [m].
        pad: Margin around the bounding box [m], at least three cells.
    """
    origin, cell, dims = _layout(vertices, max_cells, min_cell, pad)
    corners = _split(vertices[faces].astype(np.float32), _SPLIT_CELLS * cell)
    shape = wp.vec3i(*dims)
    corners_d = wp.array(corners, dtype=wp.vec3, device="cpu")
    key = wp.full(int(np.prod(dims)), np.iinfo(np.uint64).max, dtype=wp.uint64, device="cpu")
    args = [wp.vec3(*origin.tolist()), cell, shape]
    wp.launch(kernels.nearest_face_band, len(corners), [corners_d, *args, _BAND_CELLS * cell], [key], device="cpu")
    face = to_numpy(key).view(np.uint32).reshape(-1, 2)[:, 0].view(np.int32)  # low word; -1 where no face came near
    source = _nearest_band_cell(face.reshape(dims) < 0)  # (n,)
    distance = wp.empty(len(face), dtype=float, device="cpu")
    nearest = wp.array(face[source], dtype=wp.int32, device="cpu")
    wp.launch(
        kernels.far_distance, len(face), [corners_d, nearest, *args, _BAND_CELLS * cell], [distance], device="cpu"
    )
    if closed:
        inside = _closed_inside(vertices, faces, origin, cell, dims)
    else:
        inside = _open_inside(vertices, faces, np.flatnonzero(face >= 0), source, args, len(face))
    values = to_numpy(distance).reshape(dims)
    values = np.where(inside.reshape(dims), -values, values)
    return SdfGrid(np.ascontiguousarray(values, np.float32), origin, cell)


def sample_sdf(sdf: SdfGrid, points: np.ndarray) -> np.ndarray:
    """Trilinear distances [m], shape (n,), at points [m], shape (n, 3); points outside the grid are clamped to it."""
    at = (np.asarray(points, np.float64) - sdf.origin) / sdf.cell
    return ndimage.map_coordinates(sdf.values, at.T, np.float64, order=1, mode="nearest")


def _layout(vertices: np.ndarray, max_cells: int, min_cell: float, pad: float) -> tuple[np.ndarray, float, tuple]:
    """Origin, spacing and node counts of the finest isotropic grid that respects the bounds."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    cell = min_cell

    def counts() -> np.ndarray:
        return np.ceil((high - low + 2.0 * max(pad, 3.0 * cell)) / cell - 1e-6).astype(int) + 1

    while counts().prod() > max_cells:
        cell *= max(1.0005, (counts().prod() / max_cells) ** (1.0 / 3.0) * 0.995)
    cell = float(np.float32(cell))
    dims = counts()
    origin = 0.5 * (low + high) - 0.5 * cell * (dims - 1)
    return origin.astype(np.float32), cell, tuple(int(n) for n in dims)


def _split(corners: np.ndarray, longest: float) -> np.ndarray:
    """Triangles (n, 3, 3) cut at the middle of their longest edge until no edge exceeds ``longest``."""
    done = []
    while len(corners):
        edge = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)  # (n, 3), edge e runs from corner e
        long = edge.max(axis=1) > longest
        done.append(corners[~long])
        corners, edge = corners[long], edge[long]
        turn = (np.argmax(edge, axis=1)[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners, turn[..., None], axis=1).transpose(1, 0, 2)
        mid = 0.5 * (a + b)
        corners = np.concatenate([np.stack([a, mid, c], axis=1), np.stack([mid, b, c], axis=1)])
    return np.ascontiguousarray(np.concatenate(done))


def _nearest_band_cell(far: np.ndarray) -> np.ndarray:
    """Flat index of the band cell nearest to every cell, shape (n,)."""
    index = np.empty((3, *far.shape), np.int32)
    ndimage.distance_transform_edt(far, return_distances=False, return_indices=True, indices=index)
    return (index[0] * far.shape[1] + index[1]).ravel() * far.shape[2] + index[2].ravel()


def _closed_inside(vertices: np.ndarray, faces: np.ndarray, origin: np.ndarray, cell: float, dims: tuple) -> np.ndarray:
    """Inside flags of all cells from the signed surface crossings of z columns."""
    shifted = origin.astype(np.float64) + cell * np.array(_LATTICE_SHIFT)
    step = wp.zeros(dims, dtype=wp.int32, device="cpu")
    mesh = [wp.array(vertices, dtype=wp.vec3d, device="cpu"), wp.array(faces, dtype=wp.int32, device="cpu")]
    lattice = [wp.vec3d(*shifted.tolist()), cell, wp.vec3i(*dims)]
    wp.launch(kernels.lattice_crossings, len(faces), [*mesh, *lattice], [step], device="cpu")
    return np.cumsum(to_numpy(step), axis=2, dtype=np.int32) > 0


def _open_inside(
    vertices: np.ndarray, faces: np.ndarray, band: np.ndarray, source: np.ndarray, args: list, count: int
) -> np.ndarray:
    """Inside flags: winding number in the band, elsewhere that of the nearest band cell."""
    points = wp.array(vertices, dtype=wp.vec3, device="cpu")
    mesh = wp.Mesh(points, wp.array(faces.ravel(), dtype=wp.int32, device="cpu"), support_winding_number=True)
    flag = wp.empty(len(band), dtype=wp.int32, device="cpu")
    inputs = [mesh.id, wp.array(band, dtype=wp.int32, device="cpu"), *args, 2.0 * _BAND_CELLS * args[1]]
    wp.launch(kernels.winding_sign, len(band), inputs, [flag], device="cpu")
    inside = np.zeros(count, bool)
    inside[band] = to_numpy(flag) == 1
    return inside[source]

"""Regions of an object -> how much each point of its surface belongs to them."""

import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.geometry.obj_file import RawMesh
from lgrasp.object.kernels import locate_points
from lgrasp.object.load import load_mesh, read_bytes, read_raw
from lgrasp.object.region_text import Region
from lgrasp.runtime.fetch import to_numpy

MEMBER = 0.5
"""Least weight of a point that belongs to a region."""
_SKIN = 0.0005  # [m] outside a mesh that still counts as inside: a part cut out of the object shares its surface
_SAME_COLOUR = 2  # largest difference of a channel, of 255
_NAMES_TOLD = 8


def region_weights(regions: Sequence[Region], points: np.ndarray, mesh: Path, *, scale: float = 1.0) -> np.ndarray:
    """How much points of an object's surface belong to the union of some regions.

    Args:
        points: in the object's frame [m], (n, 3).
        mesh: the object's file, whose groups, colours and vertices are meant.
        scale: factor from its unit, and that of other mesh files, to metres.

    Returns:
        0 to 1, (n,) f32; points from ``MEMBER`` on are in it.

    Raises:
        ConfigError: a region that the object does not have, or of none of the points; one line.
        ObjectError: a mesh file that cannot be used.
    """
    points = np.asarray(points, float)
    found = np.zeros(len(points))
    raw = read_raw(mesh) if any(r.kind in ("group", "color", "weights") for r in regions) else None
    for region in regions:
        if region.kind == "box":
            low, high = np.reshape(region.numbers, (2, 3))
            own = ((points >= low) & (points <= high)).all(axis=1).astype(float)
        elif region.kind == "sphere":
            own = (np.linalg.norm(points - region.numbers[:3], axis=1) <= region.numbers[3]).astype(float)
        elif region.kind == "mesh":
            own = _inside(region, points, scale)
        else:
            assert raw is not None
            face, corner, _ = _locate(raw.vertices * scale, raw.faces, points)
            own = (corner * _corner_weights(region, raw, mesh)[face]).sum(axis=1)
        if not (own >= MEMBER).any():
            low, high = points.min(axis=0).round(3), points.max(axis=0).round(3)
            raise ConfigError(
                f"region '{region.text}' holds none of the {len(points):,} points of {mesh} that a finger may touch; "
                f"they lie in {_triple(low)} to {_triple(high)} m"
            )
        found = np.maximum(found, own)
    return found.astype(np.float32)


def _triple(x: np.ndarray) -> str:
    return ",".join(f"{value:g}" for value in x)


def _inside(region: Region, points: np.ndarray, scale: float) -> np.ndarray:
    """1 for points inside a closed mesh or on it, (n,)."""
    assert region.file is not None
    mesh = load_mesh(region.file, scale=scale)
    if not mesh.closed:
        raise ConfigError(f"region '{region.text}': {region.file} is not watertight; a closed mesh is accepted")
    face, corner, within = _locate(mesh.vertices, mesh.faces, points)
    foot = np.einsum("nk,nkd->nd", corner, mesh.vertices[mesh.faces[face]])
    return (within | (np.linalg.norm(points - foot, axis=1) <= _SKIN)).astype(float)


def _locate(vertices: np.ndarray, faces: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Nearest face of each point (n,), barycentric coordinates there (n, 3), and whether it is inside (n,)."""
    corners = wp.array(vertices, dtype=wp.vec3, device="cpu")
    mesh = wp.Mesh(corners, wp.array(faces.ravel(), dtype=wp.int32, device="cpu"), support_winding_number=True)
    face, inside = (wp.empty(len(points), dtype=wp.int32, device="cpu") for _ in range(2))
    foot = wp.empty(len(points), dtype=wp.vec3, device="cpu")
    reach = 10.0 * float(np.ptp(np.vstack([vertices[np.unique(faces)], points]), axis=0).max())
    inputs = [mesh.id, wp.array(points, dtype=wp.vec3, device="cpu"), reach]
    wp.launch(locate_points, len(points), inputs, [face, foot, inside], device="cpu")
    return to_numpy(face), to_numpy(foot).astype(float), to_numpy(inside) == 1


def _corner_weights(region: Region, raw: RawMesh, path: Path) -> np.ndarray:
    """Weights of the corners of the faces, (f, 3)."""
    if region.kind == "weights":
        assert region.file is not None
        return _vertex_weights(region.file, len(raw.vertices), path)[raw.faces]
    if region.kind == "group":
        if region.name not in raw.groups:
            names = ", ".join(sorted(raw.groups)[:_NAMES_TOLD]) or "none (an .obj file with g, o or usemtl has some)"
            raise ConfigError(f"region '{region.text}': {path} has no group '{region.name}'; it has: {names}")
        weights = np.zeros((len(raw.faces), 3))
        weights[raw.groups[region.name]] = 1.0
        return weights
    if raw.colours is None:
        raise ConfigError(
            f"region '{region.text}': {path} has no colours of vertices; an .obj or .ply file may have them"
        )
    wanted = np.frombuffer(bytes.fromhex(region.name), np.uint8).astype(int)
    same = (np.abs(raw.colours.astype(int) - wanted) <= _SAME_COLOUR).all(axis=1)
    if not same.any():
        colours, count = np.unique(raw.colours, axis=0, return_counts=True)
        most = ", ".join(f"#{bytes(c.tolist()).hex()}" for c in colours[np.argsort(-count)[:_NAMES_TOLD]])
        raise ConfigError(f"region '{region.text}': no vertex of {path} has this colour; most have: {most}")
    return same.astype(float)[raw.faces]


def _vertex_weights(file: Path, vertices: int, mesh: Path) -> np.ndarray:
    """What an .npz says of each vertex of a mesh, (v,)."""
    accepted = f"accepted: one array 'weights' of numbers from 0 to 1, one a vertex of {mesh}, {vertices:,}"
    read_bytes(file, (".npz",), "an .npz of weights", ConfigError)
    try:
        with np.load(file, allow_pickle=False) as archive:
            name = "weights" if "weights" in archive.files or len(archive.files) != 1 else archive.files[0]
            weights = np.asarray(archive[name])
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile) as error:
        raise ConfigError(f"{file}: no weights can be read ({str(error)[:80]}); {accepted}") from None
    if weights.shape not in ((vertices,), (vertices, 1)) or weights.dtype.kind not in "fiub":
        raise ConfigError(f"{file}: {weights.dtype} of shape {weights.shape}; {accepted}")
    weights = weights.ravel().astype(float)
    bad = ~((weights >= 0) & (weights <= 1))
    if bad.any():
        first = int(np.argmax(bad))
        raise ConfigError(f"{file}: weight {weights[first]:g} of vertex {first}; {accepted}")
    return weights

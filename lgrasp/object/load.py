"""Mesh files: read, merge, orient, close small holes, check units; every repair is put in words."""

import hashlib
import io
import os
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial import cKDTree
from trimesh.graph import connected_component_labels
from trimesh.resolvers import FilePathResolver

from lgrasp.errors import LgraspError, ObjectError, short_reason
from lgrasp.geometry.edges import bodies, open_edges
from lgrasp.geometry.mesh_files import check_whole, mesh_bytes, mesh_digest
from lgrasp.geometry.obj_file import RawMesh, read_obj
from lgrasp.geometry.quiet import quiet_parsers
from lgrasp.geometry.winding import outward
from lgrasp.object.find import MESH_SUFFIXES
from lgrasp.object.mass import united_bodies
from lgrasp.object.params import ObjectParams
from lgrasp.paths import check_input

_FLAT = 1e-4  # thinner than this share of the largest side is a plane
_ROUNDING = 1e-4  # of a largest side, by files of single precision
_SAME = 1e-8  # [m] between vertices that are one
_FARTHEST = 100.0  # [m] from the origin; a shard's numbers are 0.01 mm apart there
_MOST_UNPACKED = 256 << 20
_ONE_SIZE = (".ply", ".off")  # whose parsers want faces of as many corners each
_UNITS = ((0.001, "millimetres"), (0.01, "centimetres"), (0.0254, "inches"))


@dataclass(frozen=True)
class LoadedMesh:
    """A mesh in the user's frame, scaled to metres and repaired.

    Attributes:
        name: File stem, or the mesh's own name.
        sha256: Hex digest of the source bytes.
        vertices: Vertices [m], shape (v, 3), f64.
        faces: Vertex indices, outward winding, shape (f, 3), int32.
        closed: Whether every directed edge is matched by its opposite.
        notes: What was repaired, one sentence each.
    """

    name: str
    sha256: str
    vertices: np.ndarray
    faces: np.ndarray
    closed: bool
    notes: tuple[str, ...]


def load_mesh(
    source: str | os.PathLike[str] | trimesh.Trimesh, *, scale: float = 1.0, params: ObjectParams | None = None
) -> LoadedMesh:
    """Read a mesh file (or take a trimesh), scale it to metres and repair what can be repaired safely.

    Args:
        source: Path of a mesh file (see ``MESH_SUFFIXES``), or a ``trimesh.Trimesh``.
        scale: Factor from the file's unit to metres.

    Raises:
        ObjectError: The file is missing or unreadable, or the mesh is empty, flat, not finite or of an unlikely size.
    """
    params = params or ObjectParams()
    if not (np.isfinite(scale) and scale > 0.0):
        raise ObjectError(f"scale {scale} cannot be used; a positive number such as 0.001 (millimetres to metres) is")
    if isinstance(source, trimesh.Trimesh):
        label = name = str(source.metadata.get("name") or "mesh")
        vertices, faces, parts = np.asarray(source.vertices, np.float64), np.asarray(source.faces), 1
        sha = hashlib.sha256(vertices.tobytes() + np.ascontiguousarray(faces, np.int64).tobytes()).hexdigest()
    else:
        path = Path(source)
        label, name = str(path), path.stem
        data = read_bytes(path, MESH_SUFFIXES, "a mesh file", ObjectError)
        try:
            files = mesh_bytes(path, data)
        except OSError as error:
            raise ObjectError(f"{label}: {error.filename or label}: {error.strerror or error}") from error
        sha = mesh_digest(files)
        meshes = _mesh_parts(path, files)
        (vertices, faces), parts = _join_parts(path, meshes), len(meshes)
    if not len(faces):
        raise ObjectError(f"{label}: 0 faces; a triangle mesh of a solid is accepted")
    used = np.zeros(len(vertices), bool)
    used[faces.ravel()] = True
    bad = int((~np.isfinite(vertices[used]).all(axis=1)).sum())
    if bad:
        raise ObjectError(
            f"{label}: {bad} of {int(used.sum())} vertices are NaN or infinite; finite coordinates are accepted"
        )
    notes = [f"joined {parts} geometries into one object"] if parts > 1 else []
    vertices = vertices * scale
    _check_size(label, vertices[used], scale, params)
    vertices, faces = _weld(label, vertices, faces, notes)
    faces = outward(vertices, faces, notes)
    vertices, faces = close_holes(vertices, faces, params.hole_perimeter, notes)
    loose = len(open_edges(faces))
    if loose:
        notes.append(f"not watertight ({loose} open edges): inside is decided by winding number")
    else:
        vertices, faces = _unite(vertices, faces, notes)
    return LoadedMesh(name, sha, vertices, faces.astype(np.int32), loose == 0, tuple(notes))


def read_bytes(path: Path, suffixes: Sequence[str], what: str, error: type[LgraspError]) -> bytes:
    """All bytes of an input file.

    Args:
        what: what is accepted, such as ``a mesh file``.
        error: raised, in one line, for no file, an unknown suffix, a file that cannot be read or is empty.
    """
    check_input(path, suffixes, what, error)
    try:
        data = path.read_bytes()
    except OSError as problem:
        why = f"cannot be read ({problem.strerror}); a readable {what.partition(' ')[2]} is accepted"
        raise error(f"{path}: {why}") from problem
    if not data:
        raise error(f"{path}: 0 bytes; {what} ({', '.join(suffixes)}) is accepted")
    return data


def read_raw(path: Path) -> RawMesh:
    """A mesh file as it was written: vertices in the file's order, named groups of faces, colours of vertices.

    Raises:
        ObjectError: it cannot be read, or holds no faces.
    """
    data = read_bytes(path, MESH_SUFFIXES, "a mesh file", ObjectError)
    if path.suffix.lower() == ".obj":
        return _parse_obj(path, data)
    meshes = _mesh_parts(path, mesh_bytes(path, data))
    vertices, faces = _join_parts(path, meshes)
    painted: list[Any] = [m.visual for m in meshes]
    coloured = all(visual.kind == "vertex" for visual in painted)
    colours = np.concatenate([np.asarray(visual.vertex_colors)[:, :3] for visual in painted]) if coloured else None
    return RawMesh(vertices, faces, {}, colours)


class _Buffers(FilePathResolver):
    """Gives a parser the buffers that were read, and textures, which change no shape, as they are on disk."""

    def __init__(self, path: Path, files: Mapping[str, bytes]) -> None:
        super().__init__(str(path))
        self._files = files

    def get(self, name: str) -> bytes:
        return self._files[name] if name in self._files else super().get(name)


def _check_archive(data: bytes) -> None:
    """Refuse an archive that unpacks to more than a mesh needs."""
    size = sum(member.file_size for member in zipfile.ZipFile(io.BytesIO(data)).infolist())
    if size > _MOST_UNPACKED:
        raise ValueError(f"it unpacks to {size:,} bytes, at most {_MOST_UNPACKED:,} are read")


def _mesh_parts(path: Path, files: Mapping[str, bytes]) -> list[trimesh.Trimesh]:
    """The geometries of a mesh file's bytes, of which nothing is merged."""
    kind = path.suffix.lower()[1:]
    try:
        check_whole(kind, files[""])
    except ValueError as error:
        raise ObjectError(f"{path}: {error}") from None
    if kind == "obj":  # read by the file's own numbers, which regions go by too
        raw = _parse_obj(path, files[""])
        return [trimesh.Trimesh(raw.vertices, raw.faces, process=False)]
    options: dict[str, Any] = {}
    if kind == "gltf":
        options["resolver"] = _Buffers(path, files)
    try:
        if kind == "3mf":
            _check_archive(files[""])
        with quiet_parsers():
            scene = trimesh.load_scene(io.BytesIO(files[""]), file_type=kind, process=False, **options)
            meshes = [m for m in scene.dump() if isinstance(m, trimesh.Trimesh) and len(m.faces)]
    except Exception as error:  # the parsers raise anything on garbage
        raise _unreadable(path, error) from error
    if not meshes:
        raise ObjectError(f"{path}: 0 faces; a .{kind} file with a triangle mesh of a solid is accepted")
    return meshes


def _parse_obj(path: Path, data: bytes) -> RawMesh:
    """The mesh of an OBJ file's bytes."""
    try:
        return read_obj(data)
    except ValueError as error:
        raise _unreadable(path, error) from error


def _unreadable(path: Path, error: Exception) -> ObjectError:
    kind = path.suffix.lower()
    accepted = "triangles, in .obj any polygons, are" if kind in _ONE_SIZE else "a triangle mesh file is"
    return ObjectError(f"{path}: not a readable {kind} mesh ({short_reason(error, 120)}); {accepted} accepted")


def _join_parts(path: Path, meshes: Sequence[trimesh.Trimesh]) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (v, 3) and faces (f, 3) of all geometries of a file."""
    starts = np.cumsum([0, *(len(m.vertices) for m in meshes)])
    faces = np.concatenate([np.asarray(m.faces, np.int64) + start for m, start in zip(meshes, starts, strict=False)])
    vertices = np.concatenate([np.asarray(m.vertices, np.float64) for m in meshes])
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ObjectError(
            f"{path}: a face names vertex {faces.max()} of {len(vertices)}; existing vertices are accepted"
        )
    return vertices, faces


def _check_size(label: str, vertices: np.ndarray, scale: float, params: ObjectParams) -> None:
    """Refuse extents that a unit mistake explains, planes, and coordinates that single precision blurs."""
    extent = float(np.ptp(vertices, axis=0).max())
    if not params.min_extent * (1 - _ROUNDING) <= extent <= params.max_extent * (1 + _ROUNDING):
        side = f"largest side is {extent:.4g} m" + ("" if scale == 1.0 else f" at scale {scale:g}")
        accepted = f"{params.min_extent:g} to {params.max_extent:g} m is accepted"
        raise ObjectError(f"{label}: {side}; {accepted}{_remedy(extent, scale)}")
    far = float(np.linalg.norm((vertices.min(axis=0) + vertices.max(axis=0)) / 2))
    if far > _FARTHEST:
        accepted = f"up to {_FARTHEST:g} m is accepted: move it"
        raise ObjectError(f"{label}: the mesh is {far:,.0f} m from the origin of its coordinates; {accepted}")
    spread = vertices - vertices.mean(axis=0)
    axes = np.linalg.eigh(spread.T @ spread)[1]
    thin = float(np.ptp(spread @ axes, axis=0).min())
    if thin < _FLAT * extent:
        raise ObjectError(f"{label}: flat mesh, {thin:.2g} m thick at {extent:.2g} m length; a solid is accepted")


def _remedy(extent: float, scale: float) -> str:
    raw = extent / scale
    if extent == 0.0 or not np.isfinite(extent):
        return ""
    if scale != 1.0 and 0.02 <= raw <= 0.5:
        return "; it is in metres already: use --scale 1"
    for factor, unit in _UNITS:
        if 0.02 <= raw * factor <= 0.6:
            return f"; if the file is in {unit} use --scale {factor:g}"
    return f"; for a hand-sized object use --scale {10.0 ** round(np.log10(0.1 / raw)):g}"


def _weld(label: str, vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Merge equal vertices, drop unused ones and faces that name a vertex twice."""
    used = np.unique(faces)
    grid = np.round((vertices[used] - vertices[used].mean(axis=0)) / _SAME).astype(np.int64)
    _, first, inverse = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    lookup = np.zeros(len(vertices), np.int64)
    lookup[used] = inverse.ravel()
    if len(open_edges(lookup[faces])):  # equal vertices may lie in two cells of the grid
        near = cKDTree(vertices[used[first]]).query_pairs(_SAME, output_type="ndarray")
        group = connected_component_labels(near, len(first))
        lookup[used] = group[inverse.ravel()]
        first = _least(group, first)
    keep = np.sort(first)  # in the file's order
    lookup = np.argsort(np.argsort(first))[lookup]
    faces = lookup[faces]
    if len(keep) < len(used):
        notes.append(f"merged {len(used) - len(keep)} duplicate vertices")
    whole = (faces != np.roll(faces, 1, axis=1)).all(axis=1)
    if not whole.all():
        notes.append(f"dropped {int((~whole).sum())} faces that had collapsed to a line or point")
    vertices, faces = vertices[used][keep], _drop_twins(faces[whole], notes)
    a, b, c = (vertices[faces] - vertices.mean(axis=0)).transpose(1, 0, 2) if len(faces) else np.zeros((3, 0, 3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    extent = np.ptp(vertices, axis=0).max()
    if area < 1e-8 * extent**2:
        raise ObjectError(f"{label}: surface of {area:.2g} m² (degenerate faces); a solid is accepted")
    return vertices, faces


def _least(label: np.ndarray, values: np.ndarray) -> np.ndarray:
    """The least value of each label, from 0 on."""
    out = np.full(int(label.max()) + 1, np.iinfo(np.int64).max)
    np.minimum.at(out, label, values)
    return out


def _drop_twins(faces: np.ndarray, notes: list[str]) -> np.ndarray:
    """Drop repeated faces, and every second side of bodies that are two-sided throughout."""
    start = np.argmin(faces, axis=1)[:, None] if len(faces) else np.zeros((0, 1), np.int64)
    turned = np.take_along_axis(faces, (start + np.arange(3)) % 3, axis=1)  # smallest index first, same winding
    first = np.sort(np.unique(turned, axis=0, return_index=True)[1])
    if len(first) < len(faces):
        notes.append(f"dropped {len(faces) - len(first)} repeated faces")
    faces = faces[first]
    _, sides, number = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    if len(sides) == len(faces):
        return faces
    body, back = bodies(faces), np.ones(len(faces), bool)
    back[sides] = False
    single = np.bincount(body[sides[number == 1]], minlength=int(body.max()) + 1) > 0
    back &= ~single[body]
    if back.any():
        notes.append(f"dropped {int(back.sum())} back faces of a two-sided mesh")
    return faces[~back]


def _unite(vertices: np.ndarray, faces: np.ndarray, notes: list[str]) -> tuple[np.ndarray, np.ndarray]:
    """Bodies of a closed mesh that overlap or touch become one: no surface is left inside."""
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    with quiet_parsers():
        found = united_bodies(vertices - middle, faces)
    if found is None:
        return vertices, faces
    notes.append(f"united {int(bodies(faces).max()) + 1} bodies that overlap or touch")
    return found[0] + middle, found[1]


def close_holes(
    vertices: np.ndarray, faces: np.ndarray, perimeter: float, notes: list[str]
) -> tuple[np.ndarray, np.ndarray]:
    """Fill boundary loops up to ``perimeter`` [m] with a fan around their centre, and note how many; a boundary that
    branches stays open.

    Args:
        vertices: [m], shape (v, 3).
        faces: vertex indices of consistent winding, shape (f, 3).
    """
    loose = open_edges(faces)
    follow = {int(b): int(a) for a, b in loose}  # against the faces' own direction
    if not len(loose) or len(follow) < len(loose):  # closed, or a boundary that branches
        return vertices, faces
    fans, centres = [], []
    while follow:
        loop = [next(iter(follow))]
        while loop[-1] in follow:
            loop.append(follow.pop(loop[-1]))
        if loop[0] != loop[-1]:
            continue
        ring = np.array(loop)
        edge = vertices[ring[1:]] - vertices[ring[:-1]]
        if np.linalg.norm(edge, axis=1).sum() <= perimeter:
            hub = len(vertices) + len(centres)
            centres.append(vertices[ring[:-1]].mean(axis=0))
            fans.append(np.stack([ring[:-1], ring[1:], np.full(len(edge), hub)], axis=1))
    if fans:
        notes.append(f"filled {len(fans)} holes of at most {perimeter * 1000.0:g} mm perimeter")
        vertices, faces = np.concatenate([vertices, centres]), np.concatenate([faces, *fans])
    return vertices, faces

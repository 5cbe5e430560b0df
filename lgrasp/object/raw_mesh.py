"""A mesh file as it was written: vertices in the file's order, named groups of faces, colours of vertices."""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.errors import ObjectError
from lgrasp.geometry.mesh_files import mesh_bytes
from lgrasp.object.find import MESH_SUFFIXES
from lgrasp.object.load import join_parts, mesh_parts, read_bytes


@dataclass(frozen=True)
class RawMesh:
    """A mesh of which nothing is merged or repaired.

    Attributes:
        vertices: In the file's unit and order, shape (v, 3), f64.
        faces: Triangles, into which polygons are cut, shape (f, 3).
        groups: Faces by the name of their group, object or material; of an OBJ file.
        colours: Of the vertices, shape (v, 3), u8; None where the file has none.
    """

    vertices: np.ndarray
    faces: np.ndarray
    groups: dict[str, np.ndarray]
    colours: np.ndarray | None


def read_raw(path: Path) -> RawMesh:
    """A mesh file as it was written.

    Raises:
        ObjectError: it cannot be read, or holds no faces.
    """
    data = read_bytes(path, MESH_SUFFIXES, "a mesh file", ObjectError)
    if path.suffix.lower() == ".obj":
        return _read_obj(path, data.decode("utf-8", "replace").splitlines())
    meshes = mesh_parts(path, mesh_bytes(path, data))
    vertices, faces = join_parts(path, meshes)
    painted: list[Any] = [m.visual for m in meshes]
    coloured = all(visual.kind == "vertex" for visual in painted)
    colours = np.concatenate([np.asarray(visual.vertex_colors)[:, :3] for visual in painted]) if coloured else None
    return RawMesh(vertices, faces, {}, colours)


def _read_obj(path: Path, lines: Iterable[str]) -> RawMesh:
    vertices: list[list[float]] = []
    faces: list[list[int]] = []
    groups: dict[str, list[int]] = {}
    now: dict[str, list[str]] = {}  # names in force, by what gave them
    try:
        for line in lines:
            what, _, rest = line.partition("#")[0].strip().partition(" ")
            if what == "v":
                vertices.append([float(x) for x in rest.split()])
            elif what in ("o", "g", "usemtl"):
                now[what] = rest.split() if what == "g" else [rest.strip()]
            elif what == "f":
                corners = [int(corner.partition("/")[0]) for corner in rest.split()]
                corners = [i - 1 if i > 0 else len(vertices) + i for i in corners]
                for name in {name for names in now.values() for name in names}:
                    groups.setdefault(name, []).extend(range(len(faces), len(faces) + len(corners) - 2))
                faces += [[corners[0], a, b] for a, b in itertools.pairwise(corners[1:])]
        corners, points = np.array(faces, int).reshape(-1, 3), np.array([v[:3] for v in vertices], float).reshape(-1, 3)
        coloured = bool(vertices) and all(len(v) == 6 for v in vertices)
        colours = np.array([v[3:] for v in vertices]) if coloured else np.zeros((0, 3))
    except ValueError as error:
        raise ObjectError(f"{path}: not a readable .obj mesh ({error}); a triangle mesh file is accepted") from None
    if not len(corners) or corners.min() < 0 or corners.max() >= len(points):
        raise ObjectError(
            f"{path}: {len(corners)} faces of {len(points)} vertices; faces of existing vertices are accepted"
        )
    whole = np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8) if coloured else None
    return RawMesh(points, corners, {name: np.array(rows) for name, rows in groups.items() if name}, whole)

"""A mesh file as it was written: vertices in the file's order, named groups of faces, colours of vertices."""

from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.errors import ObjectError
from lgrasp.geometry.mesh_files import mesh_bytes
from lgrasp.geometry.obj_file import RawMesh
from lgrasp.object.find import MESH_SUFFIXES
from lgrasp.object.load import join_parts, mesh_parts, parse_obj, read_bytes


def read_raw(path: Path) -> RawMesh:
    """A mesh file as it was written.

    Raises:
        ObjectError: it cannot be read, or holds no faces.
    """
    data = read_bytes(path, MESH_SUFFIXES, "a mesh file", ObjectError)
    if path.suffix.lower() == ".obj":
        return parse_obj(path, data)
    meshes = mesh_parts(path, mesh_bytes(path, data))
    vertices, faces = join_parts(path, meshes)
    painted: list[Any] = [m.visual for m in meshes]
    coloured = all(visual.kind == "vertex" for visual in painted)
    colours = np.concatenate([np.asarray(visual.vertex_colors)[:, :3] for visual in painted]) if coloured else None
    return RawMesh(vertices, faces, {}, colours)

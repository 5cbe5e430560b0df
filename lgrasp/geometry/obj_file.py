"""Wavefront OBJ: vertices in the file's order, polygons cut into triangles, named groups of faces, vertex colours."""

import codecs
import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from lgrasp.geometry.polygons import cut_polygons

_COMMENT = re.compile(r"(^|\s)#.*")
_NAMES = ("o", "g", "usemtl")


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


def read_obj(data: bytes) -> RawMesh:
    """The mesh of an OBJ file's bytes.

    Raises:
        ValueError: they cannot be read, or hold no faces.
    """
    vertices: list[list[str]] = []
    corners: list[int] = []
    sizes: list[int] = []
    groups: dict[str, list[int]] = {}  # polygons
    now: dict[str, list[str]] = {}  # names in force, by what gave them
    for what, rest in _statements(data):
        if what == "v":
            vertices.append(rest.split())
        elif what in _NAMES:
            now[what] = rest.split() if what == "g" else [rest]
        elif what == "f":
            polygon = [int(corner.partition("/")[0]) for corner in rest.split()]
            if len(polygon) < 3:  # a point or a line
                continue
            if 0 in polygon or min(polygon) < -len(vertices):
                wrong = next(i for i in polygon if i == 0 or i < -len(vertices))
                raise ValueError(
                    f"a face names vertex {wrong} after {len(vertices)} vertices; they count from 1, or back from -1"
                )
            corners += [i - 1 if i > 0 else len(vertices) + i for i in polygon]
            for name in {name for names in now.values() for name in names}:
                groups.setdefault(name, []).append(len(sizes))
            sizes.append(len(polygon))
    numbers = np.array([v[:3] for v in vertices], float).reshape(-1, 3)
    coloured = bool(vertices) and all(len(v) == 6 for v in vertices)
    colours = np.array([v[3:] for v in vertices], float) if coloured else None
    if not corners:
        raise ValueError("0 faces")
    if max(corners) >= len(numbers):
        raise ValueError(f"a face names vertex {max(corners) + 1} of {len(numbers)}")
    faces, of = cut_polygons(numbers, np.array(corners), np.array(sizes))
    first = np.searchsorted(of, np.arange(len(sizes) + 1))
    named = {
        name: np.concatenate([np.arange(first[k], first[k + 1]) for k in polygons])
        for name, polygons in groups.items()
        if name
    }
    whole = None if colours is None else np.rint(255 * np.clip(colours, 0, 1)).astype(np.uint8)
    return RawMesh(numbers, faces, named, whole)


def _statements(data: bytes) -> Iterator[tuple[str, str]]:
    """Keyword and rest of each line, joined where a backslash ends it, without comments."""
    data = data.removeprefix(codecs.BOM_UTF8)
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    for line in re.sub(r"\\\r?\n", " ", text).splitlines():
        what, *rest = (_COMMENT.sub("", line) if "#" in line else line).split(None, 1)[:2] or [""]
        yield what, rest[0].strip() if rest else ""

"""Surfaces of a hand's links, where they may touch; the contact arrays made of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import trimesh

from lgrasp.geometry.union import outer_mesh
from lgrasp.hand.contacts import cover_patches, grid_arrays, link_grid
from lgrasp.hand.model import csr, stack_rows
from lgrasp.hand.tree import Tree
from lgrasp.object.sdf import SdfGrid

_OF_LINK = ("grid_shape", "grid_origin", "grid_cell", "grid_link")
_RUN_OF_LINK = {
    "grid_values": "grid_first",
    "rules": "rule_first",
    "mesh_vertices": "mesh_vertex_first",
    "mesh_faces": "mesh_face_first",
}
LINK_ARRAYS = (*_OF_LINK, *_RUN_OF_LINK, *_RUN_OF_LINK.values())
"""Arrays of a HandModel by link that may touch: its distance grid, rules and mesh."""


@dataclass(frozen=True)
class ContactLink:
    """Contact surface of one link, body frame."""

    link: str
    group: int  # that moves it; the number of groups for static links
    points: np.ndarray  # (n, 3) [m]
    normals: np.ndarray  # (n, 3)
    rules: np.ndarray  # (r, 4) forbidden cones: axis, cosine
    area: float = 0.0  # [m^2], of a side of an opposition space


@dataclass(frozen=True)
class SurfaceSamples:
    """Surface of one link in its body frame, and how often the mean fingertip sees each of its points."""

    link: str
    body: int
    area: float  # [m^2]
    points: np.ndarray  # (n, 3) [m]
    normals: np.ndarray  # (n, 3)
    seen: np.ndarray  # (n,) share of postures
    T_body_link: np.ndarray  # (4, 4)
    mesh: trimesh.Trimesh  # body frame

    @property
    def seen_area(self) -> float:
        """Area weighted by how often it is seen [m^2]."""
        return self.area * float(self.seen.mean())


def contact_arrays(
    tree: Tree,
    links: Sequence[ContactLink],
    meshes: Mapping[str, list[trimesh.Trimesh]],
    rng: np.random.Generator,
    *,
    known: Mapping[str, SdfGrid] | None = None,
) -> dict[str, np.ndarray]:
    """Arrays ``contact_*``, ``grid_*``, ``rule*`` and ``mesh_*`` of a HandModel.

    Args:
        meshes: solids of each link, body frame. known: distance grids that need not be made.
    """
    made: dict[bytes, SdfGrid] = {}
    grids: list[SdfGrid] = []
    for entry in links:
        # fingertips of one shape share one grid's work
        key = b"".join(np.round(m.vertices, 9).tobytes() for m in meshes[entry.link])
        grid = (known or {}).get(entry.link) or made.get(key)
        grids.append(grid or made.setdefault(key, link_grid(meshes[entry.link])))
    joined = [outer_mesh(meshes[entry.link]) for entry in links]
    # grids in the order given, points group by group
    order = sorted(range(len(links)), key=lambda i: links[i].group)
    flat = [links[i] for i in order]
    patches, count = [np.zeros(0, np.int32)], 0
    for entry in flat:
        patches.append(cover_patches(entry.points, entry.normals, rng) + count)
        count = int(patches[-1].max(initial=count - 1)) + 1
    repeat = np.array([len(entry.points) for entry in flat], int)
    index = np.array([tree.link_names.index(entry.link) for entry in links], np.int32)
    of_point = np.repeat(index[order], repeat)
    per_group = [sum(len(e.points) for e in flat if e.group == g) for g in range(tree.groups + 1)]
    return {
        "contact_first": csr(per_group),
        "contact_points": stack_rows([e.points for e in flat], 3),
        "contact_normals": stack_rows([e.normals for e in flat], 3),
        "contact_body": tree.link_body[of_point].astype(np.int32),
        "contact_link": of_point,
        "contact_patch": np.concatenate(patches),
        "contact_grid": np.repeat(order, repeat).astype(np.int32),
        **grid_arrays(grids),
        "grid_link": index,
        "rule_first": csr([len(entry.rules) for entry in links]),
        "rules": stack_rows([entry.rules for entry in links], 4),
        "mesh_vertex_first": csr([len(m.vertices) for m in joined]),
        "mesh_vertices": stack_rows([m.vertices for m in joined], 3),
        "mesh_face_first": csr([len(m.faces) for m in joined]),
        "mesh_faces": stack_rows([m.faces for m in joined], 3, np.int32),
    }


def join_surfaces(parts: Sequence[Mapping[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """The arrays of a hand with several contact surfaces: the groups of the first, then those of the next.

    Args:
        parts: as of :func:`contact_arrays`.
    """
    out = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    for name in ("contact_first", "grid_first", "rule_first", "mesh_vertex_first", "mesh_face_first"):
        out[name] = csr(np.concatenate([np.diff(part[name]) for part in parts]))
    sizes = {"contact_patch": [part["contact_patch"].max() + 1 for part in parts]}
    sizes["contact_grid"] = [len(part["grid_link"]) for part in parts]
    for name, size in sizes.items():
        out[name] += np.repeat(csr(size)[:-1], [len(part[name]) for part in parts])
    return out


def with_bare_links(arrays: Mapping[str, np.ndarray], others: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    """The arrays with the grids and meshes of further links, which get no contact point.

    Args:
        arrays, others: as of :func:`contact_arrays`; links of ``others`` that ``arrays`` has already are left out.
    """
    out = dict(arrays)
    for i in np.flatnonzero(~np.isin(others["grid_link"], arrays["grid_link"])):
        for name in _OF_LINK:
            out[name] = np.concatenate([out[name], others[name][i : i + 1]])
        for name, first in _RUN_OF_LINK.items():
            part = others[name][others[first][i] : others[first][i + 1]]
            out[name] = np.concatenate([out[name], part])
            out[first] = np.append(out[first], out[first][-1] + len(part)).astype(np.int32)
    return out

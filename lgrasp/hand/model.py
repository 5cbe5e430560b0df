"""HandModel: everything the stages need to know of a hand, as plain arrays that can be cached."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from lgrasp.hand.piece import Piece
from lgrasp.hand.tree import Tree

HAND_VERSION = 21
"""Raised whenever the arrays of a HandModel change meaning."""


def csr(counts: ArrayLike) -> np.ndarray:
    """(n + 1,) i32: first entry of each of n runs, and their total."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)


def stack_rows(parts: list[np.ndarray], width: int, dtype: type = np.float32) -> np.ndarray:
    """(n, width): all rows of ``parts``, of which there may be none."""
    return np.vstack(parts).astype(dtype) if parts else np.zeros((0, width), dtype)


def piece_arrays(pieces: Sequence[Piece]) -> dict[str, np.ndarray]:
    """Arrays of a HandModel for its convex pieces."""
    return {
        "vertex_first": csr([len(p.vertices) for p in pieces]),
        "vertices": stack_rows([p.vertices for p in pieces], 3),
        "plane_first": csr([len(p.planes) for p in pieces]),
        "planes": stack_rows([p.planes for p in pieces], 4),
        "piece_sphere": stack_rows([p.sphere[None] for p in pieces], 4),
        "piece_radius": np.array([p.radius for p in pieces], np.float32),
    }


@dataclass(frozen=True)
class HandModel:
    """A hand in body frames; body 0 = static base, body 1 + j = joint j of ``tree``. Lengths in metres.

    CSR arrays are named ``*_first``. The static base counts as group 0 in ``pair_first``, finger g as g + 1.
    """

    name: str
    sha256: str
    urdf_text: str
    notes: tuple[str, ...]
    contacts: tuple[int, ...]  # finger contacts k that suit this hand, empty: the pipeline decides
    tree: Tree
    canonical_box: np.ndarray  # (2, 3)
    # solids
    piece_first: np.ndarray  # (B + 1,) pieces of each body
    body_sphere: np.ndarray  # (B, 4) bounding sphere, radius -1 when the body is empty
    vertex_first: np.ndarray  # (P + 1,)
    vertices: np.ndarray  # (V, 3)
    plane_first: np.ndarray  # (P + 1,)
    planes: np.ndarray  # (F, 4)
    piece_sphere: np.ndarray  # (P, 4)
    piece_radius: np.ndarray  # (P,)
    piece_body: np.ndarray  # (P,)
    piece_link: np.ndarray  # (P,)
    sphere_first: np.ndarray  # (B + 1,) inner spheres of each body
    spheres: np.ndarray  # (S, 4)
    cluster_first: np.ndarray  # (B + 1,) clusters of surface samples of each body
    cluster_sphere: np.ndarray  # (C, 4) ball around the CLUSTER_SIZE samples of a cluster
    samples: np.ndarray  # (C * CLUSTER_SIZE, 3)
    # self-collision: piece pairs that must stay apart, by (group a, group b), a <= b
    pair_first: np.ndarray  # ((G + 1)^2 + 1,)
    pairs: np.ndarray  # (Q, 2)
    # link pairs that nearly always touch, on their true surfaces: points of one link against a grid of the other
    overlap_first: np.ndarray  # ((G + 1)^2 + 1,)
    overlap_sides: np.ndarray  # (S, 4) body of the points, body of the grid, first and last + 1 of the points
    overlap_points: np.ndarray  # (P, 3)
    overlap_grid_first: np.ndarray  # (S + 1,)
    overlap_grid_shape: np.ndarray  # (S, 3)
    overlap_grid_origin: np.ndarray  # (S, 3)
    overlap_grid_cell: np.ndarray  # (S,)
    overlap_grid_values: np.ndarray  # flat
    # W contact surfaces, one after another: 1, or one for each opposition space; palm points are of group G (last)
    contact_first: np.ndarray  # (W (G + 1) + 1,)
    contact_points: np.ndarray  # (C, 3)
    contact_normals: np.ndarray  # (C, 3)
    contact_body: np.ndarray  # (C,)
    contact_link: np.ndarray  # (C,)
    contact_patch: np.ndarray  # (C,)
    contact_grid: np.ndarray  # (C,) index of the link's grid
    grid_first: np.ndarray  # (L + 1,)
    grid_shape: np.ndarray  # (L, 3)
    grid_origin: np.ndarray  # (L, 3)
    grid_cell: np.ndarray  # (L,)
    grid_values: np.ndarray  # flat
    grid_link: np.ndarray  # (L,)
    rule_first: np.ndarray  # (L + 1,) forbidden cones of each contact link
    rules: np.ndarray  # (R, 4) axis in the body frame, cosine
    mesh_vertex_first: np.ndarray  # (L + 1,) triangle mesh of each contact link, body frame
    mesh_vertices: np.ndarray  # (W, 3)
    mesh_face_first: np.ndarray  # (L + 1,)
    mesh_faces: np.ndarray  # (T, 3)

    @property
    def groups(self) -> int:
        return self.tree.groups

    @property
    def contact_group(self) -> np.ndarray:
        """Group of each contact point, (C,); the palm's is ``groups``."""
        return np.repeat(np.tile(np.arange(self.groups + 1), self.surfaces), np.diff(self.contact_first))

    @property
    def surfaces(self) -> int:
        """Contact surfaces W."""
        return (len(self.contact_first) - 1) // (self.groups + 1)

    def contact_run(self, surface: int, group: int) -> int:
        """Entry of ``contact_first`` of a group (-1: static links) of a contact surface."""
        return surface * (self.groups + 1) + (group if group >= 0 else self.groups)

    @property
    def patches(self) -> int:
        """Contact patches of fingers and palm; those of group g are consecutive."""
        return int(self.contact_patch.max()) + 1

    @property
    def patch_first(self) -> np.ndarray:
        """(W (G + 1) + 1,) i32: first patch of each group, palm last."""
        parts = np.split(self.contact_patch, self.contact_first[1:-1])
        return np.cumsum([0, *(len(np.unique(part)) for part in parts)]).astype(np.int32)

    @property
    def dofs(self) -> int:
        return len(self.tree.joint_names)

    def random_postures(self, count: int, seed: int = 0) -> np.ndarray:
        """Postures (count, K) [rad or m], uniform inside the limits."""
        return np.random.default_rng(seed).uniform(self.tree.joint_lower, self.tree.joint_upper, (count, self.dofs))

    def piece(self, i: int) -> Piece:
        """Convex piece i, body frame."""
        vertices = self.vertices[self.vertex_first[i] : self.vertex_first[i + 1]]
        planes = self.planes[self.plane_first[i] : self.plane_first[i + 1]]
        return Piece(vertices.astype(float), planes.astype(float), float(self.piece_radius[i]))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Flat arrays for the cache; inverse of :meth:`from_arrays`."""
        out = {f.name: getattr(self, f.name) for f in fields(self) if isinstance(getattr(self, f.name), np.ndarray)}
        tree = {f.name: getattr(self.tree, f.name) for f in fields(self.tree)}
        out |= {f"tree.{k}": v for k, v in tree.items() if isinstance(v, np.ndarray)}
        text = {key: getattr(self, key) for key in ("name", "sha256", "urdf_text", "notes", "contacts")}
        text["tree"] = {k: v for k, v in tree.items() if not isinstance(v, np.ndarray)}
        out["text"] = np.frombuffer(json.dumps(text).encode(), np.uint8)
        return out

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> "HandModel":
        text: dict[str, Any] = json.loads(bytes(arrays["text"]))
        tree: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in text.pop("tree").items()}
        tree |= {k.removeprefix("tree."): v for k, v in arrays.items() if k.startswith("tree.")}
        own: dict[str, Any] = {k: v for k, v in arrays.items() if not k.startswith("tree.") and k != "text"}
        text |= {key: tuple(text[key]) for key in ("notes", "contacts")}
        return cls(tree=Tree(**tree), **own, **text)

"""The scene of a row: where the links of the hand and the objects are, and how they touch."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import trimesh

from lgrasp.errors import ShardError
from lgrasp.geometry.poses import pose_matrix
from lgrasp.geometry.union import joined_mesh
from lgrasp.grasp.hand_files import checked_urdf
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord
from lgrasp.hand.geometry import geometry_mesh, thin_mesh
from lgrasp.hand.links import link_poses
from lgrasp.hand.urdf import Urdf

_SHARP = 0.8  # least cosine between a face and its corner's mean normal; edges of less are sharp
_MOST_FACES = 8000  # of a link
_CLOUD_DOT = 0.0012  # [m] radius of a point of a cloud
_MOST_CLOUD_DOTS = 4000


class HandShape:
    """The links of a hand and how they move.

    Args:
        urdf: its meshes are read at once.
        base_link: link whose frame poses are given in.
        joint_names: columns of q, length K.

    Raises:
        HandError: a mesh cannot be used.
    """

    def __init__(self, urdf: Urdf, base_link: str, joint_names: Sequence[str]) -> None:
        self._urdf, self._base, self._columns = urdf, base_link, tuple(joint_names)
        self.links: dict[str, trimesh.Trimesh] = {}
        """Surfaces in link frames [m], of links that have one."""
        for link, geometries in urdf.links.items():
            parts = [geometry_mesh(urdf, g).apply_transform(g.T_link_geometry) for g in geometries]
            if parts:
                self.links[link] = thin_mesh(joined_mesh(parts), _MOST_FACES)

    @classmethod
    def of_record(cls, record: HandRecord) -> "HandShape":
        """The hand of a shard.

        Raises:
            ShardError, HandError: as of :func:`checked_urdf`.
        """
        with checked_urdf(record) as urdf:
            return cls(urdf, record.base_link, record.joint_names)

    def poses(self, q: np.ndarray) -> dict[str, np.ndarray]:
        """``T_base_link`` of the links that have a surface, each shape [n, 4, 4]; q [rad or m] is [n, K]."""
        poses = link_poses(self._urdf, self._base, dict(zip(self._columns, q.T, strict=True)))
        return {link: poses[link] for link in self.links}

    def placed(self, q: np.ndarray) -> dict[str, trimesh.Trimesh]:
        """The links in the base frame at one posture, shape [K]."""
        poses = self.poses(q[None])
        return {link: mesh.copy().apply_transform(poses[link][0]) for link, mesh in self.links.items()}


class ContactMarks(NamedTuple):
    """ContactMarks in the base frame; c of them."""

    points: np.ndarray
    """[m], shape (c, 3)."""
    normals: np.ndarray
    """Outward unit normals of the object, shape (c, 3)."""
    forces: np.ndarray
    """Of the hand on the object, shape (c, 3); normal parts sum to 1."""
    of: np.ndarray
    """Which object of the row, shape (c,)."""


@dataclass(frozen=True)
class PlacedObject:
    """An object of a row."""

    record: ObjectRecord
    pose: np.ndarray
    """``T_base_object``, shape (4, 4)."""

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """In the object's frame; of a point cloud balls around some of its points.

        Raises:
            ShardError: vertices that are not finite, or faces that name none of them.
        """
        points, faces = np.asarray(self.record.vertices, float), np.asarray(self.record.faces)
        if not np.isfinite(points).all() or faces.min(initial=0) < 0 or faces.max(initial=-1) >= len(points):
            raise ShardError(f"object '{self.record.id}': its vertices are not finite, or its faces name others")
        if len(faces):
            return trimesh.Trimesh(points, faces, process=False)
        return balls(points[:: max(1, len(points) // _MOST_CLOUD_DOTS)], _CLOUD_DOT, 0)

    @property
    def placed(self) -> trimesh.Trimesh:
        """In the base frame."""
        return self.mesh.copy().apply_transform(self.pose)


class Step(NamedTuple):
    """One grasp of a row; a sequence has one for each object."""

    stages: Mapping[str, np.ndarray]
    """Joints [rad or m], shape (K,), by stage."""
    held: int
    """So many objects of the row are in the hand, or about to be."""


STAGES = {"pregrasp": "q_pregrasp", "grasp": "q", "squeeze": "q_squeeze"}
"""Stages of a grasp in the order of time, with their columns."""


@dataclass(frozen=True)
class GraspScene:
    """A row; poses are in the base frame of the hand."""

    hand: HandShape
    objects: tuple[PlacedObject, ...]
    contacts: ContactMarks
    """With all objects, at the grasp."""
    steps: tuple[Step, ...]
    table: np.ndarray | None = None
    """``T_base_table`` of the plane that the object rests on, z up, below its middle, shape (4, 4)."""

    @property
    def duration(self) -> float:
        """Last time of :meth:`at`."""
        return float(len(STAGES) * len(self.steps) - 1)

    def at(self, time: float) -> tuple[np.ndarray, int]:
        """Joints, shape (K,), and how many objects are in the hand: 0 pregrasp, 1 grasp, 2 squeeze, 3 pregrasp of the
        next step, and so on, straight in between."""
        postures = np.stack([q for step in self.steps for q in step.stages.values()])
        time = float(np.clip(time, 0.0, self.duration))
        before, after = int(time), int(np.ceil(time))
        q = postures[before] + (time - before) * (postures[after] - postures[before])
        return q, self.steps[after // len(STAGES)].held


def scene_of_row(hand: HandShape, objects: Sequence[ObjectRecord], rows: GraspRows, row: int) -> GraspScene:
    """The scene of one of the rows.

    Args:
        objects: those of the shard, sorted by id.

    Raises:
        ShardError: the row names no object of these, or has values that are not finite.
    """
    slots = np.flatnonzero(rows.object_index[row] >= 0)
    if rows.object_index[row].max(initial=-1) >= len(objects):
        raise ShardError(f"object_index is {rows.object_index[row].max()}, with {len(objects)} objects")
    poses = pose_matrix(np.asarray(rows.object_pose[row, slots], float))
    placed = [PlacedObject(objects[rows.object_index[row, slot]], T) for slot, T in zip(slots, poses, strict=True)]
    there = np.isfinite(rows.contact_points[row, slots]).all(-1)  # (o, c)
    of = np.nonzero(there)[0]
    points, normals, forces = (
        np.einsum("cij,cj->ci", poses[of, :3, :3], np.asarray(values[row, slots][there], float))
        for values in (rows.contact_points, rows.contact_normals, rows.contact_forces)
    )
    own = rows.sequence
    held = [(int(slot), number) for number, slot in enumerate(slots, start=1)] if own else [(0, len(slots))]
    steps = tuple(
        Step({k: getattr(own, name)[row, slot] if own else getattr(rows, name)[row] for k, name in STAGES.items()}, n)
        for slot, n in held
    )
    numbers = [poses, points, normals, *(q for step in steps for q in step.stages.values())]
    if not all(np.isfinite(values).all() for values in numbers):
        raise ShardError("poses, contacts or joints are not finite")
    contacts = ContactMarks(points + poses[of, :3, 3], normals, forces, of)
    return GraspScene(hand, tuple(placed), contacts, steps, _table(placed, rows, row))


def _table(placed: Sequence[PlacedObject], rows: GraspRows, row: int) -> np.ndarray | None:
    tables = placed[0].record.tables if placed else None
    which = rows.table["pose"][row] if "pose" in rows.table else -1
    if tables is None or not 0 <= which < len(tables):
        return None
    *up, height, _ = np.asarray(tables[which], float)
    middle = placed[0].mesh.bounds.mean(0)
    T = trimesh.geometry.align_vectors([0, 0, 1], up)
    T[:3, 3] = middle + (height - middle @ up) * np.asarray(up)
    return placed[0].pose @ T


def table_piece(side: float = 0.2, thickness: float = 0.001) -> trimesh.Trimesh:
    """A square piece of a table [m], its top at z = 0."""
    return trimesh.creation.box((side, side, thickness)).apply_translation([0, 0, -thickness / 2])


def split_edges(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """The same surface; across sharp edges faces share no vertex, so that only curved parts are smoothed."""
    corners = (mesh.vertex_normals[mesh.faces] * mesh.face_normals[:, None]).sum(2)  # (F, 3) cosines
    sharp = corners < _SHARP
    faces = mesh.faces.copy()
    faces[sharp] = len(mesh.vertices) + np.arange(sharp.sum())
    return trimesh.Trimesh(np.concatenate([mesh.vertices, mesh.vertices[mesh.faces[sharp]]]), faces, process=False)


def balls(points: np.ndarray, radius: float, subdivisions: int = 2) -> trimesh.Trimesh:
    """Balls of a radius [m] around points (n, 3) [m]; n > 0."""
    ball = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    vertices = (points[:, None] + ball.vertices).reshape(-1, 3)
    faces = (len(ball.vertices) * np.arange(len(points))[:, None, None] + ball.faces).reshape(-1, 3)
    return trimesh.Trimesh(vertices, faces, process=False)

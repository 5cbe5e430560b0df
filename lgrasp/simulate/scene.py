"""Input of a simulator: a hand as URDF and convex pieces, objects as convex pieces and their mass properties."""

import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import trimesh

from lgrasp.errors import PhysicsError
from lgrasp.files import temporary_folder
from lgrasp.geometry.decompose import Decompose
from lgrasp.geometry.decompose import decompose as cut_mesh
from lgrasp.grasp.hand_files import write_hand
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.hand.geometry import link_pieces
from lgrasp.hand.piece import Piece
from lgrasp.hand.urdf import read_urdf
from lgrasp.simulate.solid import Solid, solid_of_mesh


@dataclass(frozen=True)
class HandSolids:
    """A hand's URDF text and the convex pieces of each link, link frame [m]."""

    name: str
    urdf: str
    base_link: str
    """Frame of all poses; it does not move."""
    joint_names: tuple[str, ...]
    """Columns of q."""
    link_names: tuple[str, ...]
    pieces: dict[str, list[Piece]]
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Scene:
    """A hand and objects, for any simulator and protocol; each is itself only."""

    hand: HandSolids
    objects: tuple[Solid, ...]
    """In the order that ``object_index`` of the rows counts."""


def scene_of(
    hand: HandRecord, objects: Sequence[ObjectRecord], decompose: Decompose = cut_mesh, device: str = "cpu"
) -> Scene:
    """The scene of a hand and the objects that rows may have, in whatever order they are given.

    Args:
        decompose: cuts dented meshes, perhaps with a cache (:func:`lgrasp.geometry.decompose.decompose`).
        device: answers the geometric queries.

    Raises:
        ShardError: a mesh of the hand is missing.
        HandError: the hand's URDF or a mesh cannot be used.
        ObjectError: an object is flat.
    """
    solids = [object_of_record(record, decompose, device) for record in sorted(objects, key=lambda record: record.id)]
    return Scene(hand_of_record(hand, decompose, device), tuple(solids))


def hand_of_record(record: HandRecord, decompose: Decompose, device: str = "cpu") -> HandSolids:
    """The hand of a shard, cut into the convex pieces that the generator uses.

    Raises:
        ShardError: a mesh that the URDF names is not in the shard.
        HandError: the URDF or a mesh cannot be used.
    """
    pieces, notes = {}, []
    with temporary_folder() as folder:
        urdf = read_urdf(write_hand(record, folder))
        for link in urdf.links:
            pieces[link], said = link_pieces(urdf, link, decompose, device)
            notes += said
    return HandSolids(
        name=record.name,
        urdf=record.urdf,
        base_link=record.base_link,
        joint_names=tuple(record.joint_names),
        link_names=tuple(record.link_names),
        pieces=pieces,
        notes=tuple(notes),
    )


def object_of_record(record: ObjectRecord, decompose: Decompose = cut_mesh, device: str = "cpu") -> Solid:
    """The object of a shard as a solid, in the frame of its vertices.

    Raises:
        PhysicsError: a point cloud.
    """
    if not len(record.faces):
        raise PhysicsError(f"object '{record.name}' is a point cloud; a simulator needs a mesh, as of a complete scan")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        mesh = trimesh.Trimesh(np.asarray(record.vertices, float), np.asarray(record.faces), process=True)
    return replace(solid_of_mesh(record.name, mesh, decompose, device), tables=record.tables)

"""Input of a simulator: a hand as URDF and convex pieces, objects as convex pieces and their mass properties."""

from collections.abc import Sequence
from dataclasses import dataclass

from lgrasp.geometry.decompose import Decompose
from lgrasp.geometry.decompose import decompose as cut_mesh
from lgrasp.grasp.hand_files import checked_urdf
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.hand.geometry import link_pieces
from lgrasp.hand.piece import Piece
from lgrasp.hand.urdf import Joint
from lgrasp.simulate.solid import Solid, object_of_record


@dataclass(frozen=True)
class HandSolids:
    """A hand; its base link does not move."""

    record: HandRecord
    joints: tuple[Joint, ...]
    """Of its URDF."""
    pieces: dict[str, list[Piece]]
    """Convex pieces of each link, link frame [m]."""
    cut: frozenset[str]
    """Links that have more pieces than collision elements, as these are no convex solids."""


@dataclass(frozen=True, eq=False)
class Scene:
    """A hand and objects, for any simulator and protocol; each is itself only."""

    hand: HandSolids
    objects: tuple[Solid, ...]
    """In the order that ``object_index`` of the rows counts."""


def scene_of(hand: HandRecord, objects: Sequence[ObjectRecord], decompose: Decompose = cut_mesh) -> Scene:
    """The scene of a hand and the objects that rows may have, in whatever order they are given.

    Args:
        decompose: cuts dented meshes, perhaps with a cache (:func:`lgrasp.geometry.decompose.decompose`).

    Raises:
        ShardError: a mesh of the hand is missing.
        HandError: the hand's URDF or a mesh cannot be used.
        PhysicsError, ObjectError: an object is a point cloud, or flat.
    """
    solids = [object_of_record(record, decompose) for record in sorted(objects, key=lambda record: record.id)]
    return Scene(hand_of_record(hand, decompose), tuple(solids))


def hand_of_record(record: HandRecord, decompose: Decompose) -> HandSolids:
    """The hand of a shard, cut into the convex pieces that the generator uses.

    Raises:
        ShardError, HandError: as of :func:`checked_urdf`.
    """
    with checked_urdf(record) as urdf:
        pieces = {link: link_pieces(urdf, link, decompose)[0] for link in urdf.links}
        cut = frozenset(link for link, elements in urdf.links.items() if len(pieces[link]) > len(elements))
    return HandSolids(record, urdf.joints, pieces, cut)

"""Hand and object of a job as the records of a shard, and as the scene of a simulator."""

from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events, PartProgress
from lgrasp.geometry.decompose import Decompose, decompose
from lgrasp.geometry.mesh_files import one_file
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.hand.find import HandSource
from lgrasp.hand.model import HandModel
from lgrasp.hand.urdf import read_urdf
from lgrasp.object.model import ObjectModel, SteeredObject

if TYPE_CHECKING:
    from lgrasp.simulate.scene import Scene

RULES = "hand_rules"
"""Key of a shard's config: the contents of the hand's hand.yaml, as JSON text (the order of its keys counts)."""
SURROUNDED = "surrounded"
"""Key of the config of plans that had to avoid other things, which the shard does not hold."""


def hand_config(source: HandSource) -> dict[str, Any]:
    """The hand in the config of a shard: its rules, and joints held fixed [rad or m]."""
    return {RULES: source.spec.model_dump_json(), "locked": dict(source.spec.locked)}


def mesh_blobs(urdf: Path) -> dict[str, bytes]:
    """Collision meshes of a hand by the path its URDF names, read where the hand is now, not where it was cached."""
    return {name: one_file(file) for name, file in read_urdf(urdf).mesh_files.items()}


def hand_record(hand: HandModel, meshes: dict[str, bytes]) -> HandRecord:
    """The hand; ``meshes`` are its :func:`mesh_blobs`."""
    tree = hand.tree
    return HandRecord(
        name=hand.name,
        base_link=tree.base_link,
        urdf=hand.urdf_text,
        joint_names=tree.listed_names,
        joint_lower=tree.listed_limits[:, 0],
        joint_upper=tree.listed_limits[:, 1],
        link_names=tree.link_names,
        sha256=hand.sha256,
        meshes=meshes,
    )


def object_record(
    obj: ObjectModel, id: str | None = None, tables: np.ndarray | None = None, steered: SteeredObject | None = None
) -> ObjectRecord:
    """The object, in the user's frame, planes that it rests on, and where it must be touched; its name defaults to
    its id."""
    regions: dict[str, Any] = {}
    if steered is not None:
        regions = {"regions": steered.weights.table(), "touch_share": steered.weights.share}
    return ObjectRecord(
        id=id or obj.name,
        name=obj.name,
        scale=obj.scale,
        sha256=obj.sha256,
        watertight=obj.watertight,
        vertices=obj.vertices,
        faces=obj.faces,
        tables=tables,
        **regions,
    )


def cutter(
    cache: Cache,
    events: Events | None = None,
    progress: PartProgress | None = None,
    cutting: Callable[[], None] | None = None,
) -> Decompose:
    """:func:`decompose` with a cache.

    Args:
        events: told whose mesh is being cut.
        progress: of the part that needs it, which ends if the job is to stop.
        cutting: called again and again while a mesh is cut.
    """

    def tell(what: str) -> None:
        if events:
            events.loading(f"convex pieces of {what}")
        if progress:
            progress.check()
        if cutting:
            cutting()

    return partial(decompose, store=cache, tell=tell)


def make_scene(cache: Cache, hand: HandModel, objects: Sequence[ObjectRecord], meshes: dict[str, bytes]) -> "Scene":
    """What the simulator is given: the scene of the job's shards; ``meshes`` are the hand's :func:`mesh_blobs`."""
    from lgrasp.simulate.scene import scene_of

    return scene_of(hand_record(hand, meshes), objects, cutter(cache))

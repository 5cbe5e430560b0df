"""Grasps of shards by object, and their hand."""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import Cache
from lgrasp.errors import ConfigError, ShardError
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.grasp.schema import POSTURES
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.model import HandModel
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.shard_inputs import hand_of_shard, mesh_hash

_COLUMNS = (*POSTURES, "candidate")


@dataclass
class Grasped:
    """An object of some shards and its columns, shard by shard."""

    record: ObjectRecord
    hand: HandRecord
    config: Mapping[str, Any]
    """Of the first of the shards."""
    columns: list[dict[str, np.ndarray]]

    def joined(self) -> dict[str, np.ndarray]:
        """``q``, ``q_pregrasp``, ``q_squeeze``, ``candidate`` and ``T_hand_object`` (N, 7) of all shards."""
        return {name: np.concatenate([columns[name] for columns in self.columns]) for name in self.columns[0]}


def read_parts(paths: Paths) -> dict[tuple[str, str], Grasped]:
    """Objects by id and hash of their mesh as grasped, all with grasps of one hand.

    Raises:
        ShardError: a file that is named is no shard of single objects, of point clouds, or has a row that is not
            finite (in a folder it is left out, with a notice); shards are of different hands; two objects have one id.
    """
    found: dict[tuple[str, str], Grasped] = {}
    first: tuple[Grasped, Path] | None = None
    for path, _, (record, columns) in gather(paths, _single, invalid=False):
        with ShardReader(path) as reader:
            attributes, config = reader.attributes, reader.header.config
            hand = first[0].hand if first else reader.hand()
        if hand.sha256 != attributes["hand_sha256"]:
            assert first
            raise ShardError(
                f"{path}: its grasps are of hand '{attributes['hand']}' (hash {attributes['hand_sha256'][:12]}), those "
                f"of {first[1]} of '{hand.name}' (hash {hand.sha256[:12]}); name shards of one hand"
            )
        part = found.setdefault((record.id, mesh_hash(record)), Grasped(record, hand, config, []))
        first = first or (part, path)
        part.columns.append(columns)
    ids = [key[0] for key in found]
    twice = next((i for i in ids if ids.count(i) > 1), None)
    if twice is not None:
        raise ShardError(
            f"the shards hold several objects of the name '{twice}' (other mesh or scale); use one of them"
        )
    return found


def _single(reader: ShardReader) -> tuple[ObjectRecord, dict[str, np.ndarray]]:
    """The object of a shard, and its columns."""
    if reader.space_names is not None or len(reader.object_ids) != 1:
        raise ShardError(f"{reader.path}: holds several objects to a row; grasps of single objects are accepted")
    (record,) = mesh_objects(reader)
    columns = {name: reader.column(name) for name in _COLUMNS}
    columns["T_hand_object"] = reader.column("object_pose")[:, 0]
    check_finite(reader.path, columns)
    return record, columns


def mesh_objects(reader: ShardReader) -> tuple[ObjectRecord, ...]:
    """The objects of a shard.

    Raises:
        ShardError: one is a point cloud.
    """
    objects = reader.objects()
    for record in objects:
        if not len(record.faces):
            raise ShardError(f"{reader.path}: object '{record.id}' is a point cloud; objects with a mesh are accepted")
    return objects


def check_finite(path: Path, columns: Mapping[str, np.ndarray]) -> None:
    """Raises ShardError at numbers that are not finite."""
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values).all(axis=tuple(range(1, values.ndim))))
        if len(bad):
            raise ShardError(
                f"{path}: {name} is not finite (row {bad[0]}, {len(bad)} rows); finite grasps are accepted"
            )


def load_hand(parts: Collection[Grasped], name: str | None, cache: Cache) -> tuple[HandModel, HandRecord]:
    """The hand of some shards, made from them; ``name``, where one is given, must be of the same hand.

    Raises:
        ConfigError: the shards are of another hand, or of another model of it.
        HandError, ShardError: see :func:`hand_of_shard`.
    """
    part = next(iter(parts))
    check_hand(part.hand, name, f"the grasps of '{part.record.id}'")
    return hand_of_shard(cache, part.hand, part.config)[1], part.hand


def check_hand(hand: HandRecord | HandModel, name: str | None, what: str) -> None:
    """Raises ConfigError where ``what``, which is of a hand, is asked for of another one."""
    if name is None:
        return
    source = hand_source(name)
    digest = hand_digest(source.urdf, source.spec)
    if hand.sha256 != digest:
        raise ConfigError(
            f"{what} are of hand '{hand.name}' (hash {hand.sha256[:12]}), not of '{source.name}' "
            f"(hash {digest[:12]}); leave the hand out, or generate them with this one"
        )

"""Grasps of shards by object, and what the exact tests need of the objects."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from lgrasp.dataset import ObjectRecord, ShardReader
from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import OBJECT_VERSION
from lgrasp.errors import ConfigError, ShardError
from lgrasp.hand.digest import hand_digest
from lgrasp.hand.find import HandSource
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.object.preprocess import preprocess_object
from lgrasp.runtime.device import Device

_COLUMNS = ("q", "q_pregrasp", "q_squeeze", "candidate")


@dataclass
class Part:
    """An object of some shards and its columns, shard by shard."""

    record: ObjectRecord
    hand: tuple[str, str]
    """Name and hash."""
    columns: list[dict[str, np.ndarray]]

    def joined(self) -> dict[str, np.ndarray]:
        """``q``, ``q_pregrasp``, ``q_squeeze``, ``candidate`` and ``T_hand_object`` (N, 7) of all shards."""
        return {name: np.concatenate([columns[name] for columns in self.columns]) for name in self.columns[0]}


def read_parts(paths: Sequence[Path]) -> dict[tuple[str, str], Part]:
    """Objects by id and hash of their mesh as grasped, all with grasps of one hand.

    Raises:
        ShardError: a file is no shard of single objects, of point clouds, has a row that is not finite, or is of
            another hand than the others; two objects have one id.
    """
    found: dict[tuple[str, str], Part] = {}
    first: tuple[tuple[str, str], Path] | None = None
    for path in paths:
        with ShardReader(path) as reader:
            if reader.space_names is not None or len(reader.object_ids) != 1:
                raise ShardError(f"{path}: holds several objects; grasps of single objects are brought into scenes")
            (record,), attributes = reader.objects(), reader.attributes
            columns = {name: reader.column(name) for name in _COLUMNS}
            columns["T_hand_object"] = reader.column("object_pose")[:, 0]
        if not len(record.faces):
            raise ShardError(f"{path}: object '{record.id}' is a point cloud; objects with a mesh are accepted")
        _check_finite(path, columns)
        key = (record.id, record_hash(record))
        hand = (str(attributes["hand"]), str(attributes["hand_sha256"]))
        first = first or (hand, path)
        if hand != first[0]:
            (a, b), (c, d) = hand, first[0]
            raise ShardError(
                f"{path}: its grasps are of hand '{a}' (hash {b[:12]}), those of {first[1]} of '{c}' (hash {d[:12]}); "
                "name shards of one hand"
            )
        part = found.setdefault(key, Part(record, hand, []))
        part.columns.append(columns)
    ids = [key[0] for key in found]
    twice = next((i for i in ids if ids.count(i) > 1), None)
    if twice is not None:
        raise ShardError(
            f"the shards hold several objects of the name '{twice}' (other mesh or scale); use one of them"
        )
    return found


def _check_finite(path: Path, columns: dict[str, np.ndarray]) -> None:
    for name, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(axis=1))
        if len(bad):
            raise ShardError(
                f"{path}: {name} is not finite (row {bad[0]}, {len(bad)} rows); finite grasps are accepted"
            )


def record_hash(record: ObjectRecord) -> str:
    """SHA-256 of a mesh as grasped."""
    h = hashlib.sha256(np.ascontiguousarray(record.vertices, np.float32).tobytes())
    h.update(np.ascontiguousarray(record.faces, np.int32).tobytes())
    return h.hexdigest()


def check_hand(hand: HandSource, parts: Sequence[Part]) -> None:
    """Refuse grasps of another hand.

    Raises:
        ConfigError: the shards are of another hand, or of another model of it.
    """
    digest = hand_digest(hand.urdf, hand.spec)
    for part in parts:
        if part.hand[1] != digest:
            raise ConfigError(
                f"the grasps of '{part.record.id}' are of hand '{part.hand[0]}' (hash {part.hand[1][:12]}), "
                f"not of '{hand.name}' (hash {digest[:12]}); generate them with this hand"
            )


def object_model(record: ObjectRecord, cache: Cache, device: Device) -> ObjectModel:
    """What the exact tests of a hand against an object need, from the mesh as grasped."""
    params = ObjectParams()
    described = {"content": record_hash(record), "params": params.model_dump(mode="json"), "name": record.id}

    def make() -> dict[str, np.ndarray]:
        mesh = trimesh.Trimesh(np.asarray(record.vertices, float), np.asarray(record.faces), process=False)
        mesh.metadata["name"] = record.id
        return preprocess_object(mesh, params=params, device=device.alias).to_arrays()

    arrays, _ = cache.get("object", content_key("object", OBJECT_VERSION, **described), make)
    return ObjectModel.from_arrays(arrays)

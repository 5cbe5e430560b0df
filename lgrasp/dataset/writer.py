"""Writes one whole shard, or nothing."""

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import h5py
import numpy as np

from lgrasp.dataset.checks import hand_problems, object_problems, row_problems
from lgrasp.dataset.files import new_shard_file
from lgrasp.dataset.structure import structure_problems, text_sha256
from lgrasp.errors import ShardError
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, Shard, ShardHeader, object_set_sha256
from lgrasp.grasp.schema import CHUNK_ROWS, FORMAT, FORMAT_VERSION, GRASP_FIELDS, SEQUENCE_FIELDS, DatasetSpec


def write_shard(path: str | os.PathLike[str], shard: Shard) -> None:
    """Write a shard; the file appears under ``path`` only when it is whole and on the disk.

    Arrays are converted to the dtypes of the format. The same shard always gives the same bytes.

    Raises:
        ShardError: The shard violates the format (shapes, limits, padding, ...); nothing is written.
        OutputError: The folder cannot be written or is full; no file is left behind.
    """
    rows = _as_format(shard.grasps, where=path)
    with new_shard_file(path) as file:
        write_context(file, shard.header, shard.hand, shard.objects, shard.statistics)
        if rows.sequence is not None:
            write_spaces(file, rows.sequence.space_names)
        for name, values in rows.columns().items():
            unit = rows.metric_units.get(name.removeprefix("metrics/"), "")
            protocol = rows.physics_protocols.get(name.removeprefix("physics/"), "")
            dataset = create_rows(file, name, values.shape, values.dtype, unit=unit, protocol=protocol)
            if values.size:
                dataset[...] = values
        finish(file)
        problems = structure_problems(file) or [
            *hand_problems(shard.hand),
            *(problem for record in shard.objects for problem in object_problems(record)),
            *row_problems(
                rows, shard.hand, [o.id for o in shard.objects], lambda name, a, b: rows.columns()[name][a:b]
            ),
        ]
        if problems:
            raise ShardError(f"cannot write {path}: {problems[0]}")


def write_context(file: h5py.File, header: ShardHeader, hand: HandRecord, objects: Any, statistics: Any) -> None:
    """Write all that is not a row: header attributes, hand, objects, statistics, and the empty row groups.

    Raises:
        ShardError: The object ids are not sorted, not unique or not usable as a group name.
    """
    ids = [o.id for o in objects]
    if ids != sorted(set(ids)) or any(not i or "/" in i or i == "." for i in ids):
        raise ShardError(f"object ids must be unique, sorted and without '/': {ids}")
    file.attrs.update(
        format=FORMAT,
        format_version=FORMAT_VERSION,
        lgrasp_version=header.lgrasp_version,
        hand=hand.name,
        pipeline=header.pipeline,
        created=header.created,
        seed=np.int64(header.seed),
        shard_index=np.int64(header.shard_index),
        config=json.dumps(dict(header.config), sort_keys=True),
        hand_sha256=hand.sha256,
        object_sha256=object_set_sha256(objects) if objects else "",
    )
    if header.merged_from:
        file.attrs["merged_from"] = json.dumps([dict(m) for m in header.merged_from])
    write_hand(file.create_group("hand"), hand)
    for record in objects:
        write_object(file.create_group(f"objects/{record.id}"), record)
    for name in ("metrics", "physics", "provenance"):
        file.create_group(f"grasps/{name}")
    file.create_group("statistics").attrs.update(dict(statistics))


def write_spaces(file: h5py.File, space_names: Sequence[str]) -> None:
    """Write the opposition spaces that ``sequence/space`` indexes, which make a file one of sequences."""
    _create_texts(file.create_group("sequence"), "space_names", space_names)


def write_hand(group: h5py.Group, hand: HandRecord) -> None:
    """Write a hand into its empty group."""
    group.attrs["base_link"] = hand.base_link
    group.create_dataset("urdf", data=hand.urdf, dtype=h5py.string_dtype())
    _create_texts(group, "joint_names", hand.joint_names)
    _create_texts(group, "link_names", hand.link_names)
    create_array(group, "joint_lower", np.asarray(hand.joint_lower, dtype="f4"))
    create_array(group, "joint_upper", np.asarray(hand.joint_upper, dtype="f4"))
    for number, (mesh_path, blob) in enumerate(hand.meshes.items()):
        dataset = create_array(group, f"meshes/{number}", np.frombuffer(blob, dtype="u1"))
        dataset.attrs["path"] = mesh_path


def write_object(group: h5py.Group, record: ObjectRecord) -> None:
    """Write an object into its empty group."""
    group.attrs.update(
        name=record.name, scale=float(record.scale), sha256=record.sha256, watertight=bool(record.watertight)
    )
    create_array(group, "vertices", np.asarray(record.vertices, dtype="f4"))
    create_array(group, "faces", np.asarray(record.faces, dtype="i4"))
    if record.normals is not None:
        create_array(group, "normals", np.asarray(record.normals, dtype="f4"))


def create_rows(file: h5py.File, name: str, shape, dtype, *, unit: str = "", protocol: str = "") -> h5py.Dataset:
    """Make one empty row dataset, chunked along its rows.

    Args:
        file: The shard being written.
        name: Flat name as in :meth:`GraspRows.columns`.
        shape: Full shape, rows first.
        dtype: NumPy dtype.
        unit: Unit, for a metric.
        protocol: Protocol, for a physics verdict.
    """
    path = GRASP_FIELDS[name].path if name in GRASP_FIELDS else f"grasps/{name}"
    chunks = (min(shape[0], CHUNK_ROWS), *shape[1:])
    dataset = file.create_dataset(path, shape, dtype, **(_filters(chunks) if np.prod(shape) else {}))
    if name.startswith("metrics/"):
        dataset.attrs["unit"] = unit
    elif name.startswith("physics/"):
        dataset.attrs["protocol"] = protocol
    return dataset


def finish(file: h5py.File) -> None:
    """Mark a file as complete; the last write."""
    file.attrs["complete"] = np.int64(1)
    file.attrs["text_sha256"] = text_sha256(file)


def _filters(chunks: tuple[int, ...]) -> dict[str, Any]:
    return {"chunks": chunks, "compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


def create_array(group: h5py.Group, name: str, data: np.ndarray) -> h5py.Dataset:
    """A dataset in one chunk (HDF5 allows none for an empty one)."""
    return group.create_dataset(name, data=data, **(_filters(data.shape) if data.size else {}))


def _create_texts(group: h5py.Group, name: str, texts: Any) -> None:
    """Strings of fixed length, which the checksum covers (those of variable length live outside the chunk)."""
    encoded = [text.encode() for text in texts]
    dtype = h5py.string_dtype("utf-8", max((len(e) for e in encoded), default=1) or 1)
    create_array(group, name, np.array(encoded, dtype=dtype))


def _as_format(rows: GraspRows, *, where: Any) -> GraspRows:
    """The rows with the format's dtypes; an integer that does not fit is an error."""

    def converted(source: Any, specs: Mapping[str, DatasetSpec]) -> dict[str, Any]:
        columns = {}
        for name, spec in specs.items():
            member = name.removeprefix("sequence/")
            values = np.asarray(getattr(source, member))
            columns[member] = values.astype(spec.numpy, copy=False)
            if spec.numpy.kind in "biu" and not np.array_equal(columns[member], values):
                raise ShardError(f"cannot write {where}: {spec.path} holds values that do not fit {spec.numpy}")
        return columns

    for name in rows.physics:
        if not rows.physics_protocols.get(name):
            raise ShardError(f"cannot write {where}: physics verdict {name!r} names no protocol")
    metrics = {name: np.asarray(values, dtype="f4") for name, values in sorted(rows.metrics.items())}
    physics = {name: np.asarray(values) for name, values in sorted(rows.physics.items())}
    steps = rows.sequence and replace(rows.sequence, **converted(rows.sequence, SEQUENCE_FIELDS))
    return replace(rows, **converted(rows, GRASP_FIELDS), metrics=metrics, physics=physics, sequence=steps)

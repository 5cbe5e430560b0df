"""Writes one whole shard, or nothing, on full disks too."""

import io
import json
import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lgrasp.dataset.checks import hand_problems, object_problems, row_problems
from lgrasp.dataset.structure import members, structure_problems, text_sha256
from lgrasp.errors import ShardError
from lgrasp.files import locked, new_file
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, Shard, object_set_sha256
from lgrasp.grasp.schema import (
    CHUNK_ROWS,
    FORMAT,
    FORMAT_VERSION,
    GRASP_FIELDS,
    SEQUENCE_FIELDS,
    TABLE_FIELDS,
    DatasetSpec,
)
from lgrasp.paths import name_problem

_LIBVER = ("v110", "v110")  # readable since HDF5 1.10; its metadata blocks carry checksums, the older layout's do not


class _Sink(io.FileIO):
    """Binary file for HDF5 that remembers the first write error instead of raising it.

    The HDF5 library aborts the process when a write fails while it closes a file (disk full). Here it sees every
    write succeed, closes in peace, and :func:`new_shard_file` reports the error afterwards.
    """

    error: OSError | None = None

    def readinto(self, buffer) -> int:
        n = super().readinto(buffer) or 0
        buffer[n:] = bytes(len(buffer) - n)  # only short after a failed write
        return len(buffer)

    def write(self, data) -> int:
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            try:
                done += super().write(view[done:]) or 0
            except OSError as error:
                self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        if self.error is None:
            try:
                super().truncate(size)
            except OSError as error:
                self.error = error
        return size or 0


@contextmanager
def new_shard_file(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """An empty HDF5 file, open for writing, that appears as ``path`` only when the block ends without an error.

    Raises:
        OutputError: As :func:`new_file`.
    """
    with new_file(path) as raw:
        sink = _Sink(raw.fileno(), "r+", closefd=False)
        with h5py.File(sink, "w", libver=_LIBVER) as file:
            yield file
        if sink.error is not None:
            raise sink.error


def write_shard(path: str | os.PathLike[str], shard: Shard) -> None:
    """Write a shard; the file appears under ``path`` only when it is whole and on the disk.

    Arrays are converted to the dtypes of the format. The same shard always gives the same bytes.

    Raises:
        ShardError: The shard violates the format (shapes, limits, padding, ...); nothing is written.
        OutputError: The folder cannot be written or is full; no file is left behind.
    """
    rows = _as_format(shard.grasps, where=path)
    columns, texts = rows.columns(), column_texts(rows)
    # a process that is adding columns to the file that is there would put its copy in place of the new one
    with locked(Path(path)) if os.path.isfile(path) else nullcontext(), new_shard_file(path) as file:
        write_context(file, shard)
        for name, values in columns.items():
            dataset = create_rows(file, name, values.shape, values.dtype, texts.get(name, ""))
            if values.size:
                dataset[...] = values
        nodes = finish(file)
        problems = structure_problems(nodes) or [
            *hand_problems(shard.hand),
            *(problem for record in shard.objects for problem in object_problems(record)),
            *row_problems(rows, shard.hand, shard.objects, lambda name, a, b: columns[name][a:b]),
        ]
        if problems:
            raise ShardError(f"cannot write {path}: {problems[0]}")


def column_texts(rows: GraspRows) -> dict[str, str]:
    """Units of metrics and protocols of verdicts, by flat name."""
    groups = (("metrics", rows.metric_units), ("physics", rows.physics_protocols))
    return {f"{group}/{name}": text for group, texts in groups for name, text in texts.items()}


def write_context(file: h5py.File, shard: Shard) -> None:
    """Write all but the rows: header attributes, hand, objects, statistics, the empty row groups, and the opposition
    spaces of sequences.

    Raises:
        ShardError: The object ids are not sorted or not unique, or a name cannot be used.
    """
    header, hand, objects, steps = shard.header, shard.hand, shard.objects, shard.grasps.sequence
    ids = [o.id for o in objects]
    if ids != sorted(set(ids)):
        raise ShardError(f"object ids must be unique and sorted: {ids}")
    for name in (hand.name, *ids):
        if problem := name_problem(name):
            raise ShardError(f"name {name!r} cannot be used: {problem}")
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
    write_models(file, hand, objects)
    for name in ("metrics", "physics", "provenance"):
        file.create_group(f"grasps/{name}")
    file.create_group("statistics").attrs.update(dict(shard.statistics))
    if steps is not None:
        _create_texts(file.create_group("sequence"), "space_names", steps.space_names)


def write_models(file: h5py.File, hand: HandRecord, objects: Sequence[ObjectRecord]) -> None:
    """Write the groups of a hand and of objects."""
    _write_hand(file.create_group("hand"), hand)
    for record in objects:
        _write_object(file.create_group(f"objects/{record.id}"), record)


def _write_hand(group: h5py.Group, hand: HandRecord) -> None:
    group.attrs["base_link"] = hand.base_link
    group.create_dataset("urdf", data=hand.urdf, dtype=h5py.string_dtype())
    _create_texts(group, "joint_names", hand.joint_names)
    _create_texts(group, "link_names", hand.link_names)
    create_array(group, "joint_lower", hand.joint_lower, "f4")
    create_array(group, "joint_upper", hand.joint_upper, "f4")
    for number, (mesh_path, blob) in enumerate(hand.meshes.items()):
        dataset = create_array(group, f"meshes/{number}", np.frombuffer(blob, "u1"), "u1")
        dataset.attrs["path"] = mesh_path


def _write_object(group: h5py.Group, record: ObjectRecord) -> None:
    group.attrs.update(
        name=record.name, scale=float(record.scale), sha256=record.sha256, watertight=bool(record.watertight)
    )
    create_array(group, "vertices", record.vertices, "f4")
    create_array(group, "faces", record.faces, "i4")
    for name in ("normals", "tables", "regions"):
        if (values := getattr(record, name)) is not None:
            create_array(group, name, values, "f4")
    if record.regions is not None:
        group.attrs["touch_share"] = float(record.touch_share)


def create_rows(file: h5py.File, name: str, shape: Sequence[int], dtype: np.dtype, text: str) -> h5py.Dataset:
    """Make one empty row dataset by its flat name, chunked along its rows; the text is the unit of a metric, the
    protocol of a verdict."""
    path = GRASP_FIELDS[name].path if name in GRASP_FIELDS else f"grasps/{name}"
    chunks = (min(shape[0], CHUNK_ROWS), *shape[1:])
    dataset = file.create_dataset(path, shape, dtype, **(_filters(chunks) if np.prod(shape) else {}))
    if name.startswith(("metrics/", "physics/")):
        dataset.attrs["unit" if name.startswith("metrics/") else "protocol"] = text
    return dataset


def finish(file: h5py.File) -> dict[str, Any]:
    """Mark a file as complete, the last write; its :func:`~lgrasp.dataset.structure.members`."""
    nodes = members(file)
    file.attrs["complete"] = np.int64(1)
    file.attrs["text_sha256"] = text_sha256(nodes)
    return nodes


def create_array(group: h5py.Group, name: str, data: Any, dtype: Any) -> h5py.Dataset:
    """A dataset in one chunk (HDF5 allows none for an empty one)."""
    data = np.asarray(data, dtype)
    return group.create_dataset(name, data=data, **(_filters(data.shape) if data.size else {}))


def _filters(chunks: tuple[int, ...]) -> dict[str, Any]:
    return {"chunks": chunks, "compression": "gzip", "compression_opts": 1, "shuffle": True, "fletcher32": True}


def _create_texts(group: h5py.Group, name: str, texts: Sequence[str]) -> None:
    """Strings of fixed length, which the checksum covers (those of variable length live outside the chunk)."""
    encoded = [text.encode() for text in texts]
    create_array(group, name, encoded, h5py.string_dtype("utf-8", max((len(e) for e in encoded), default=1) or 1))


def _as_format(rows: GraspRows, *, where: Any) -> GraspRows:
    """The rows with the format's dtypes; an integer that does not fit is an error."""

    def converted(source: Any, specs: Mapping[str, DatasetSpec]) -> dict[str, Any]:
        columns = {}
        for name, spec in specs.items():
            member = name.rpartition("/")[2]
            values = np.asarray(source[member] if isinstance(source, Mapping) else getattr(source, member))
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
    table = rows.table and converted(rows.table, TABLE_FIELDS)
    kept = {"metrics": metrics, "physics": physics, "sequence": steps, "table": table}
    return replace(rows, **converted(rows, GRASP_FIELDS), **kept)

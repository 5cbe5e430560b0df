"""Puts the rows of many shards of one hand and one object set into one file, and lists the shards of a folder."""

import json
import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lgrasp.dataset.checks import row_problems
from lgrasp.dataset.files import Paths, check_heaps, find_shards, new_file, new_shard_file, sha256_file
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.writer import create_rows, finish, write_context, write_spaces
from lgrasp.errors import ShardError
from lgrasp.grasp.records import GraspRows, HandRecord, ShardHeader
from lgrasp.grasp.schema import CHUNK_ROWS, GRASP_FIELDS, SEQUENCE_FIELDS


def merge_shards(paths: Paths, out: str | os.PathLike[str], *, manifest: str | os.PathLike[str] | None = None) -> int:
    """Copy the rows of shards, ordered by shard index, into one shard file; streams, so memory stays bounded.

    The shards must agree in hand, objects, pipeline, config and seed, and in the names of metrics and verdicts. Rows
    with fewer objects or contacts than the widest shard are padded. Statistics are summed. Of sequences, the rows of
    one object of all shards come first, then those of two, and so on; ``sequence/parent`` follows.

    Args:
        paths: Shard files, or a folder of them.
        out: The file to write; if it lies in the folder, it is not merged into itself.
        manifest: List to check the shards against; by default ``manifest.json`` of the folder, if there is one.

    Returns:
        The number of rows written.

    Raises:
        ShardError: A shard is missing, damaged, changed, given twice, or does not belong to the others.
        OutputError: ``out`` cannot be written.
    """
    found = find_shards(paths)
    folder = Path(paths) if isinstance(paths, str | os.PathLike) else None
    if folder and folder.is_dir():
        found = [path for path in found if not _same_file(path, out)]
        if manifest is None and (folder / MANIFEST_NAME).exists():
            manifest = folder / MANIFEST_NAME
    if not found or any(_same_file(path, out) for path in found):
        raise ShardError(f"{out}: must not be one of the shards to merge")
    if manifest is not None:
        check_manifest(manifest, found)
    sources = sorted((_survey(path) for path in found), key=lambda s: (s.header.shard_index, s.path.name))
    for source in sources[1:]:
        _require_same(sources[0], source)
    _require_once(sources)
    with new_shard_file(out) as file:
        hand = _write_head(file, sources)
        _copy_rows(file, sources, hand)
        finish(file)
    return sum(source.rows for source in sources)


def sum_statistics(parts: Sequence[Mapping[str, int | float | str]]) -> dict[str, int | float | str]:
    """Statistics of several shards together: numbers are added, different strings are listed."""
    total: dict[str, Any] = {}
    for name in sorted({name for part in parts for name in part}):
        values: list[Any] = [part[name] for part in parts if name in part]
        texts = any(isinstance(value, str) for value in values)
        total[name] = ", ".join(sorted({str(v) for v in values})) if texts else sum(values)
    return total


@dataclass(frozen=True)
class _Source:
    path: Path
    rows: int
    header: ShardHeader
    statistics: dict[str, int | float | str]
    identity: dict[str, Any]
    """What must agree, by a name for the message."""
    starts: tuple[int, ...]
    """First row of each number of objects, from 0 on, and the end; of rows that are no sequences: 0 and the end."""
    tails: dict[str, tuple[int, ...]]
    units: dict[str, str]
    protocols: dict[str, str]
    dtypes: dict[str, np.dtype]

    def parts(self) -> list[dict[str, Any]]:
        if self.header.merged_from:
            return [dict(part) for part in self.header.merged_from]
        return [{"file": self.path.name, "shard_index": self.header.shard_index, "rows": self.rows}]


def _same_file(path: Path, out: str | os.PathLike[str]) -> bool:
    return Path(out).exists() and path.samefile(out)


def _survey(path: Path) -> _Source:
    check_heaps(path)
    with ShardReader(path) as reader:
        header, hand, empty = reader.header, reader.hand(), reader.rows(0, 0)
        known = GRASP_FIELDS | SEQUENCE_FIELDS
        extra = {n: (len(shape), dtype.str) for n, (shape, dtype) in reader.columns.items() if n not in known}
        identity = {
            "hand": (hand.name, hand.sha256[:12], *hand.joint_names),
            "objects": [(o.id, o.sha256[:12], o.scale) for o in reader.objects()],
            "pipeline": header.pipeline,
            "config": dict(header.config),
            "seed": header.seed,
            "opposition spaces": reader.space_names,
            "metrics and physics": extra,
            "metric units": dict(empty.metric_units),
            "physics protocols": dict(empty.physics_protocols),
        }
        return _Source(
            path=path,
            rows=len(reader),
            header=header,
            statistics=reader.statistics,
            starts=_starts(reader),
            identity=identity,
            tails={name: shape[1:] for name, (shape, _) in reader.columns.items()},
            units=dict(empty.metric_units),
            protocols=dict(empty.physics_protocols),
            dtypes={name: dtype for name, (_, dtype) in reader.columns.items()},
        )


def _starts(reader: ShardReader) -> tuple[int, ...]:
    if reader.space_names is None:
        return 0, len(reader)
    index = reader.column("object_index")  # (n, o)
    held = np.bincount((index >= 0).sum(1), minlength=index.shape[1] + 1)
    return 0, *np.cumsum(held).tolist()


def _require_same(first: _Source, other: _Source) -> None:
    for what, value in other.identity.items():
        if value != first.identity[what]:
            mine, theirs = str(value)[:100], str(first.identity[what])[:100]
            rule = "merge only shards of one hand, one object set and one run"
            raise ShardError(f"{other.path}: {what} {mine} differs from {theirs} of {first.path}; {rule}")


def _require_once(sources: Sequence[_Source]) -> None:
    holder: dict[int, Path] = {}
    for source in sources:
        for part in source.parts():
            index = part["shard_index"]
            if index in holder:
                raise ShardError(f"{source.path}: shard {index} is already in {holder[index]}; leave one out")
            holder[index] = source.path


def _write_head(file: h5py.File, sources: Sequence[_Source]) -> HandRecord:
    header = ShardHeader(
        pipeline=sources[0].header.pipeline,
        seed=sources[0].header.seed,
        shard_index=-1,
        config=sources[0].header.config,
        created=max(source.header.created for source in sources),
        lgrasp_version=", ".join(sorted({source.header.lgrasp_version for source in sources})),
        merged_from=[part for source in sources for part in source.parts()],
    )
    with ShardReader(sources[0].path) as reader:
        hand = reader.hand()
        statistics = sum_statistics([source.statistics for source in sources])
        write_context(file, header, hand, reader.objects(), statistics)
        if reader.space_names is not None:
            write_spaces(file, reader.space_names)
    return hand


def _copy_rows(file: h5py.File, sources: Sequence[_Source], hand: HandRecord) -> None:
    total, first = sum(source.rows for source in sources), sources[0]
    datasets: dict[str, h5py.Dataset] = {}
    for name, dtype in first.dtypes.items():
        unit = first.units.get(name.removeprefix("metrics/"), "")
        protocol = first.protocols.get(name.removeprefix("physics/"), "")
        shape = (total, *widest(source.tails[name] for source in sources))
        datasets[name] = create_rows(file, name, shape, dtype, unit=unit, protocol=protocol)
    placed: dict[tuple[int, int], int] = {}  # where each part of each source begins
    done = 0
    for part in range(max(len(source.starts) for source in sources) - 1):
        for place, source in enumerate(sources):
            if part + 1 < len(source.starts):
                placed[place, part] = done
                shift = placed.get((place, part - 1), 0) - source.starts[max(part - 1, 0)]
                for rows in _checked(source, hand, part):
                    for name, values in rows.columns().items():
                        if name == "sequence/parent":
                            values = np.where(values < 0, values, values + shift)
                        dataset = datasets[name]
                        if dataset.size:
                            dataset[done : done + len(rows)] = pad_column(name, values, dataset.shape[1:])
                    done += len(rows)


def _checked(source: _Source, hand: HandRecord, part: int) -> Iterator[GraspRows]:
    """The rows between two of a source's ``starts``, some at a time.

    Raises:
        ShardError: They do not conform.
    """
    first, end = source.starts[part : part + 2]
    with ShardReader(source.path) as reader:
        for start in range(first, end, CHUNK_ROWS):
            rows = reader.rows(start, min(start + CHUNK_ROWS, end))
            problems = row_problems(rows, hand, reader.object_ids, reader.column, first_row=start)
            if problems:
                raise ShardError(f"{source.path}: {problems[0]}")
            yield rows


def pad_column(name: str, values: np.ndarray, tail: tuple[int, ...]) -> np.ndarray:
    """Values of one row dataset, padded at the end of each axis with the fill value of the format.

    Verdicts of a simulator, which may have a number per object, are padded with what means not run: NaN, -1 or false.

    Args:
        name: Flat name, as in :meth:`GraspRows.columns`.
        values: Shape [n, ...].
        tail: Wanted lengths of all axes but the first; none is shorter than in ``values``.

    Returns:
        Shape [n, *tail]; ``values`` itself if nothing is to be padded.
    """
    if values.shape[1:] == tail:
        return values
    spec = (GRASP_FIELDS | SEQUENCE_FIELDS).get(name)
    fill = spec.fill if spec else {"f": np.nan, "i": -1}.get(values.dtype.kind, 0)
    padded = np.full((len(values), *tail), fill, dtype=values.dtype)
    padded[tuple(slice(size) for size in values.shape)] = values
    return padded


def widest(tails: Iterable[tuple[int, ...]]) -> tuple[int, ...]:
    """The smallest tail that holds all given ones; they have the same number of axes."""
    return tuple(max(sizes) for sizes in zip(*tails, strict=True))


MANIFEST_NAME = "manifest.json"
_FORMAT = "lgrasp-manifest"
_VERSION = "1.0"


def write_manifest(folder: str | os.PathLike[str]) -> Path:
    """Write ``manifest.json`` for the shards of a folder: file, rows, shard index and SHA-256 of each.

    Raises:
        ShardError: The folder holds no shard, or a shard cannot be read.
        OutputError: The manifest cannot be written.
    """
    shards = []
    for path in find_shards(folder):
        with ShardReader(path) as reader:
            shards.append({"file": path.name, "rows": len(reader), "shard_index": reader.header.shard_index})
        shards[-1]["sha256"] = sha256_file(path)
    document = {"format": _FORMAT, "format_version": _VERSION, "rows": sum(s["rows"] for s in shards), "shards": shards}
    target = Path(folder) / MANIFEST_NAME
    with new_file(target) as file:
        file.write(json.dumps(document, indent=2).encode() + b"\n")
    return target


def check_manifest(manifest: str | os.PathLike[str], shards: Sequence[Path]) -> None:
    """Compare shard files with a manifest; files are matched by name.

    Raises:
        ShardError: The manifest cannot be read, a listed shard is missing or has another hash, or a shard is not
            listed.
    """
    try:
        document = json.loads(Path(manifest).read_bytes())
        listed = {entry["file"]: entry["sha256"] for entry in document["shards"]}
        if document["format"] != _FORMAT:
            raise ValueError(f"format is {document['format']!r}, expected {_FORMAT!r}")
    except OSError as error:
        raise ShardError(f"{manifest}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ShardError(f"{manifest}: not a manifest of shards: {error}") from error
    given = {path.name: path for path in shards}
    missing = sorted(listed.keys() - given.keys())
    if missing:
        raise ShardError(f"{manifest}: {len(missing)} of {len(listed)} shards missing, first {missing[0]}")
    unlisted = sorted(given.keys() - listed.keys())
    if unlisted:
        raise ShardError(f"{given[unlisted[0]]}: not listed in {manifest}; write the manifest again")
    for name, path in given.items():
        actual = sha256_file(path)
        if actual != listed[name]:
            raise ShardError(f"{path}: SHA-256 is {actual[:12]}…, {manifest} says {str(listed[name])[:12]}…")

"""Puts the rows of many shards of one hand and one object set into one file."""

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count, islice
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from lgrasp.dataset.checks import row_problems
from lgrasp.dataset.difference import NO_REASON, leaves, tell_difference
from lgrasp.dataset.differences import compare
from lgrasp.dataset.files import Paths, check_heaps, find_shards
from lgrasp.dataset.manifest import MANIFEST, read_manifest
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.writer import column_texts, create_rows, finish, new_shard_file, write_context
from lgrasp.errors import OutputError, ShardError
from lgrasp.grasp.records import GraspRows, HandRecord, Shard, ShardHeader, padded
from lgrasp.grasp.schema import CHUNK_ROWS, GRASP_FIELDS, SEQUENCE_FIELDS, TABLE_FIELDS
from lgrasp.notices import notice

_FIELDS = GRASP_FIELDS | SEQUENCE_FIELDS | TABLE_FIELDS


def merge_shards(
    paths: Paths,
    out: str | os.PathLike[str],
    *,
    manifest: str | os.PathLike[str] | None = None,
    partial: bool = False,
) -> int:
    """Copy the rows of shards, ordered by shard index, into one shard file; streams, so memory stays bounded.

    The shards must agree in hand, objects, pipeline, config and seed, and in the names of metrics and verdicts. Rows
    with fewer objects or contacts than the widest shard are padded. Statistics are summed. Of sequences, the rows of
    one object of all shards come first, then those of two, and so on; ``sequence/parent`` follows.

    Args:
        out: The file to write; if it lies in the folder, it is not merged into itself.
        manifest: List to check the shards against; by default ``manifest.json`` of the folder, if there is one.
        partial: Merge what is there, though the list has more.

    Returns:
        The number of rows written.

    Raises:
        ShardError: A shard is missing (unless ``partial``), damaged, changed, given twice, not in the ``manifest`` that
            is named, or does not belong to the others.
        OutputError: ``out`` cannot be written, or is there and no merged shard.
    """
    found, there = find_shards(paths), Path(out).exists()
    folder = Path(paths) if isinstance(paths, str | os.PathLike) else None
    if folder and folder.is_dir():
        found = [path for path in found if not (there and path.samefile(out))]
    if not found or any(there and path.samefile(out) for path in found):
        raise ShardError(f"{out}: must not be one of the shards to merge")
    if there and not _is_merged(Path(out)):
        raise OutputError(f"{out} exists and is no merged shard; choose another --out")
    listed = _check_manifest(found, manifest, folder, partial)
    sources = sorted((_survey(path) for path in found), key=lambda s: (s.header.shard_index, s.path.name))
    _require_one_run(sources)
    if not listed:
        _tell_gaps(sources)
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
    header: ShardHeader
    statistics: dict[str, int | float | str]
    identity: dict[str, Any]
    """What must agree, by a name for the message."""
    starts: tuple[int, ...]
    """First row of each number of objects, from 0 on, and the end; of rows that are no sequences: 0 and the end."""
    columns: dict[str, tuple[tuple[int, ...], np.dtype]]
    texts: dict[str, str]

    @property
    def rows(self) -> int:
        return self.starts[-1]

    def parts(self) -> list[dict[str, Any]]:
        if self.header.merged_from:
            return [dict(part) for part in self.header.merged_from]
        return [{"file": self.path.name, "shard_index": self.header.shard_index, "rows": self.rows}]


def _survey(path: Path) -> _Source:
    check_heaps(path)
    with ShardReader(path) as reader:
        header, hand, empty = reader.header, reader.hand(), reader.rows(0, 0)
        starts = 0, len(reader)
        if reader.space_names is not None:
            index = reader.column("object_index")  # (n, o)
            starts = 0, *np.cumsum(np.bincount((index >= 0).sum(1), minlength=index.shape[1] + 1)).tolist()
        identity = {
            "hand": {"hand": hand.name, "files": hand.sha256[:12], "joints": ", ".join(hand.joint_names)},
            "objects": {name: f"{sha256[:12]}, scale {scale}" for name, sha256, scale in reader.object_keys},
            "pipeline": header.pipeline,
            "config": dict(header.config),
            "seed": header.seed,
            "opposition spaces": reader.space_names,
            "metrics and physics": {n: (len(s), t.str) for n, (s, t) in reader.columns.items() if n not in _FIELDS},
            "metric units": dict(empty.metric_units),
            "physics protocols": dict(empty.physics_protocols),
        }
        return _Source(path, header, reader.statistics, identity, starts, reader.columns, column_texts(empty))


def _require_one_run(sources: Sequence[_Source]) -> None:
    """Refuse shards that do not belong together, and rows that would be there twice."""
    first, holder = sources[0], dict[int, Path]()
    for source in sources:
        for what, value in source.identity.items():
            if value != (other := first.identity[what]):
                rule = "merge only shards of one hand, one object set and one run"
                how = _difference(what, value, other)
                raise ShardError(f"{source.path}: {what} differs from that of {first.path} ({how}); {rule}")
    for source in sources:
        for index in (part["shard_index"] for part in source.parts()):
            if index in holder:
                raise ShardError(f"{source.path}: shard {index} is already in {holder[index]}; leave one out")
            holder[index] = source.path


def _difference(what: str, mine: Any, other: Any) -> str:
    """Which values differ in what must agree, and both of each."""
    old, new = (dict(leaves(value if isinstance(value, Mapping) else {what: value})) for value in (mine, other))
    every = sorted(old | new, key=lambda name: name in NO_REASON)
    return tell_difference(old, new, every, sides=("here", "there"), absent=("none", "none")) or "deep inside"


def _check_manifest(
    shards: Sequence[Path], named: str | os.PathLike[str] | None, folder: Path | None, partial: bool
) -> bool:
    """Compare shards with the manifest that is named, else with that of their folder; False if there is none."""
    path = Path(named) if named is not None else folder and folder / MANIFEST
    manifest = None if path is None else read_manifest(path)
    if path is None or manifest is None:
        if named is not None:
            raise ShardError(f"{named}: no manifest there")
        return False
    found = compare(shards, manifest)
    if line := found.missing_line(path):
        if not partial:
            raise ShardError(f"{line}, or merge that with --partial")
        notice(f"{line}; what is there is merged")
    for name, how in found.changed.items():
        raise ShardError(f"{path.parent / name}: {how}")
    if named is not None and found.foreign:
        raise ShardError(found.foreign_line(path))
    notice(found.foreign_line(path))
    return True


def _tell_gaps(sources: Sequence[_Source]) -> None:
    """Say which shards of a run are not among those merged, as far as their numbers tell."""
    numbers = {part["shard_index"] for source in sources for part in source.parts()}
    if gaps := max(numbers) + 1 - len(numbers):
        first = islice((number for number in count() if number not in numbers), min(gaps, 5))
        named = ", ".join(map(str, first)) + (", ..." if gaps > 5 else "")
        notice(f"{gaps} of {max(numbers) + 1} shards of this run are not merged, by their numbers: {named}")


def _is_merged(path: Path) -> bool:
    """True for a file that merging made."""
    try:
        with ShardReader(path) as reader:
            return bool(reader.header.merged_from)
    except ShardError:
        return False


def _write_head(file: h5py.File, sources: Sequence[_Source]) -> HandRecord:
    header = replace(
        sources[0].header,
        shard_index=-1,
        created=max(source.header.created for source in sources),
        lgrasp_version=", ".join(sorted({source.header.lgrasp_version for source in sources})),
        merged_from=[part for source in sources for part in source.parts()],
    )
    statistics = sum_statistics([source.statistics for source in sources])
    with ShardReader(sources[0].path) as reader:
        hand, objects, empty = reader.hand(), reader.objects(), reader.rows(0, 0)
    write_context(file, Shard(header=header, hand=hand, objects=objects, grasps=empty, statistics=statistics))
    return hand


def _copy_rows(file: h5py.File, sources: Sequence[_Source], hand: HandRecord) -> None:
    total, first = sum(source.rows for source in sources), sources[0]
    datasets: dict[str, h5py.Dataset] = {}
    for name, (_, dtype) in first.columns.items():
        tail = widest(source.columns[name][0][1:] for source in sources)
        datasets[name] = create_rows(file, name, (total, *tail), dtype, first.texts.get(name, ""))
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
    """The rows between two of a source's ``starts``, some at a time; a ShardError if they do not conform."""
    first, end = source.starts[part : part + 2]
    with ShardReader(source.path) as reader:
        objects = reader.objects()
        for start in range(first, end, CHUNK_ROWS):
            rows = reader.rows(start, min(start + CHUNK_ROWS, end))
            problems = row_problems(rows, hand, objects, reader.column, first_row=start)
            if problems:
                raise ShardError(f"{source.path}: {problems[0]}")
            yield rows


def pad_column(name: str, values: np.ndarray, tail: tuple[int, ...]) -> np.ndarray:
    """Values [n, ...] of one row dataset by its flat name, padded at the end of each axis with the fill value of the
    format to [n, *tail]; the values themselves if nothing is to be padded.

    Verdicts of a simulator, which may have a number per object, are padded with what means not run: NaN, -1 or false.
    """
    return padded(values, tail, _FIELDS[name].fill if name in _FIELDS else None)


def widest(tails: Iterable[tuple[int, ...]]) -> tuple[int, ...]:
    """The smallest tail that holds all given ones; they have the same number of axes."""
    return tuple(max(sizes) for sizes in zip(*tails, strict=True))

"""The shards that a command works on: files that were named, and those in folders that it can use."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Generic, NamedTuple, TypeVar

from lgrasp.dataset.files import Paths, named_files, shards_below
from lgrasp.dataset.reader import ShardReader
from lgrasp.errors import ShardError
from lgrasp.grasp.schema import MADE_FROM
from lgrasp.notices import notice

T = TypeVar("T")


class Gathered(NamedTuple, Generic[T]):
    """A shard that can be used."""

    path: Path
    place: Path
    """Below the folder that was named; the name of a file that was named itself."""
    value: T
    """What the look at it gave."""


def gather(
    paths: Paths,
    look: Callable[[ShardReader], T] = lambda _: None,  # ty: ignore[invalid-parameter-default]
    *,
    leave_out: Path | None = None,
    invalid: bool = True,
) -> list[Gathered[T]]:
    """The shards among files and folders of any depth, in the order of their names.

    In a folder, a file that cannot be used is left out, and so is one whose rows were made from those of another (by
    ``refine``, ``simulate --out``, ...), or are copies of them; each kind is reported in one line.

    Args:
        look: What is needed of a shard; it raises ShardError where the shard cannot be used.
        leave_out: Folder that is not looked into.
        invalid: as of :class:`~lgrasp.dataset.reader.ShardReader`.

    Raises:
        ShardError: A path does not exist, a file that was named cannot be used, or no shard is left.
    """
    found: list[Gathered[T]] = []
    merged: dict[int, set[Any]] = {}  # number of a file -> rows that it was merged from
    first: dict[Any, int] = {}  # rows -> number of their best file so far
    twice: dict[int, int] = {}  # number of a file -> of the one that it repeats
    by_name = set(named_files(paths))

    def read(path: Path) -> tuple[T, set[Any], bool]:
        with ShardReader(path, invalid=invalid) as reader:
            return look(reader), _rows_of(reader), bool(reader.header.merged_from)

    for number, (path, folder, (value, rows, is_merged)) in enumerate(sound_files(paths, read, leave_out=leave_out)):
        found.append(Gathered(path, path.relative_to(folder), value))
        if not rows or path in by_name:
            continue
        if is_merged:
            merged[number] = rows
            continue
        best = first.setdefault(*rows, number)
        if best == number or found[best].path.parent == path.parent:
            continue
        if _rank(path) > _rank(found[best].path):
            first |= dict.fromkeys(rows, number)
            twice[best] = number
        else:
            twice[number] = best
    for number, rows in sorted(merged.items(), key=lambda item: (len(item[1]), item[0])):
        there = {first[one] for one in rows if one in first}
        if rows <= first.keys():
            twice[number] = min(there)
        else:
            twice |= dict.fromkeys(there - merged.keys(), number)
            first |= dict.fromkeys(rows, number)
    if twice:
        other, best = min(twice.items())
        told = f"{found[other].path} (rows of {found[best].path})"
        notice(f"{len(twice)} of {len(found)} shards repeat rows of others and are left out, first {told}")
    return [one for number, one in enumerate(found) if number not in twice]


def sound_files(
    paths: Paths,
    read: Callable[[Path], T],
    *,
    leave_out: Path | None = None,
    named: Sequence[Path] | None = None,
    some: bool = True,
) -> list[tuple[Path, Path, T]]:
    """Files as of :func:`lgrasp.dataset.files.shards_below`, each with what was read of it; those in folders that
    cannot be used are left out, and reported in one line.

    Args:
        read: Raises ShardError where the file cannot be used.
        named: Files that were named rather than found in a folder; by default those among ``paths``.
        some: At least one must be left.

    Raises:
        ShardError: As of :func:`gather`.
    """
    found: list[tuple[Path, Path, T]] = []
    unusable: list[str] = []
    by_name = set(named_files(paths) if named is None else named)
    for path, folder in shards_below(paths, leave_out):
        try:
            found.append((path, folder, read(path)))
        except ShardError as error:
            if path in by_name:
                raise
            unusable.append(str(error))
    if some and not found:
        raise ShardError(unusable[0])
    if unusable:
        notice(f"{len(unusable)} of {len(unusable) + len(found)} files are left out, first {unusable[0]}")
    return found


def _rows_of(reader: ShardReader) -> set[Any]:
    """The same for shards of the same candidates of a run, several in a merged file; none where that is not told."""
    header = reader.header
    key = header.config.get("run_key")
    indices = [part.get("shard_index") for part in header.merged_from] or [header.shard_index]
    told = isinstance(key, str) and all(isinstance(index, int) and index >= 0 for index in indices)
    return {(key, index, *reader.object_ids) for index in indices} if told else set()


def _rank(path: Path) -> tuple[bool, int, int]:
    """Larger for the rows as they were generated, for more rows, and for more verdicts."""
    with ShardReader(path) as reader:
        verdicts = sum(name.startswith("physics/") for name in reader.columns)
        return MADE_FROM not in reader.statistics, len(reader), verdicts

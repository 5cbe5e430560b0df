"""The output folder of a job: paths of its shards, which of them exist already, and whether they may stay."""

import os
import re
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from lgrasp.dataset import ShardReader, validate_shard
from lgrasp.dataset.files import check_heaps, remove_leftovers
from lgrasp.engine.events import Part
from lgrasp.errors import OutputError, ShardError

_MAX_NAME_LENGTH = 120  # characters of a name; file systems allow 255 bytes


class _Found(NamedTuple):
    """What a whole shard says of itself."""

    key: str | None
    rows: int
    tried: int  # candidates (or rounds), when they were all that the shard may try; else 0


def shard_path(out: Path, hand: str, name: str, shard: int) -> Path:
    """File of a shard."""
    safe = re.sub(r"[^A-Za-z0-9_.-]+", "_", f"{hand}-{name}")[:_MAX_NAME_LENGTH]
    return out / f"{safe}-{shard:05d}.h5"


def check_folder(out: Path) -> None:
    """Check that files can be written into a folder, without creating it (the first shard does).

    Raises:
        OutputError: a file is in the way, or the nearest existing folder is read-only.
    """
    nearest = next(p for p in (out, *out.absolute().parents) if os.path.lexists(p))
    if not nearest.is_dir():
        raise OutputError(f"output folder {out} cannot be made: {nearest} is a file; choose another with --out")
    try:
        tempfile.TemporaryFile(dir=nearest).close()
    except OSError as error:
        why = error.strerror
        raise OutputError(f"output folder {out} cannot be written: {why}; choose another with --out") from None


def clean_folder(files: Sequence[Path]) -> None:
    """Remove leftovers of killed processes that wrote files like these; files being written stay."""
    for folder, stem in {(path.parent, _stem(path)) for path in files}:
        remove_leftovers(folder, f"{stem}-*.tmp")


def present_parts(
    parts: Sequence[Part], key: str, effort: Callable[[int], int], warn: Callable[[str], None]
) -> dict[int, int]:
    """Rows of the shards that are on disk and may stay, by number of the part.

    A shard stays when it holds what is asked (or more: nothing is thrown away when fewer are asked later), or when all
    candidates that it may try were tried.

    Args:
        key: content key of the run.
        effort: candidates that a shard of some number of rows may try.
        warn: called with one line when a file is damaged.

    Raises:
        OutputError: a file, or the folder's first of that name, belongs to another run.
    """
    if parts:
        # one of the others is enough: whoever wrote into the folder looked as well
        first, own = parts[0].file, {part.file for part in parts}
        others = sorted(set(first.parent.glob(f"{_stem(first)}-[0-9][0-9][0-9][0-9][0-9].h5")) - own)
        for path in others[:1]:
            _check_run(path, _read(path), key)
    present = {}
    for part in parts:
        if not os.path.lexists(part.file):
            continue
        problems = validate_shard(part.file)
        found = None if problems else _read(part.file)
        if found is None:
            warn(f"shard {part.file} is damaged ({(problems or ['header'])[0]}); rebuilding it")
            continue
        _check_run(part.file, found, key)
        if found.rows >= part.rows or found.tried >= effort(part.rows):
            present[part.number] = found.rows
    return present


def _stem(path: Path) -> str:
    """Name of a shard's file without its number."""
    return path.stem.rpartition("-")[0]


def _check_run(path: Path, found: _Found | None, key: str) -> None:
    if found is not None and found.key != key:
        raise OutputError(
            f"{path} belongs to another run (other hand, object, pipeline, seed or --shard-rows); "
            "choose another --out, or --overwrite to replace it"
        )


def _read(path: Path) -> _Found | None:
    """None when the file is no whole shard."""
    try:
        check_heaps(path)
        with ShardReader(path) as reader:
            config, statistics = reader.header.config, reader.statistics
            key = config.get("run_key") if isinstance(config, dict) else None
            # of a file with sequences only the whole ones count, and rounds are tried
            rows = int(statistics.get("sequences", len(reader)))
            effort = statistics.get("rounds" if "sequences" in statistics else "candidates", 0)
            return _Found(key, rows, int(effort) if statistics.get("exhausted") else 0)
    except (ShardError, ValueError):
        return None

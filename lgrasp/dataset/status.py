"""How far the runs are whose files are in some folders, by their manifests."""

from collections.abc import Iterable
from functools import cache
from pathlib import Path
from typing import Any

from lgrasp.dataset.differences import Differences, compare
from lgrasp.dataset.files import walk
from lgrasp.dataset.manifest import MANIFEST, SUFFIX, ListedRun, read_manifest, workers
from lgrasp.errors import ShardError

_NEXT = {
    "incomplete": "repeat the same command",
    "starved": "another pipeline or seed",
    "damaged": "remove the files, repeat the same command",
    "foreign": "'lgrasp dataset info' says what they are",
    "unlisted": "the next run in the folder lists them",
    "bad list": "the next run in the folder writes it again",
}


def folder_states(paths: Iterable[Path], *, verify: bool = False) -> list[dict[str, Any]]:
    """States of the runs in folders at any depth, JSON-serialisable, one entry a run; manifests and sizes are read.

    Args:
        verify: Read the files too, for their SHA-256.

    Returns:
        For each run: ``folder``, ``job``, ``run_key``, ``hand``, ``objects``, ``pipeline``, ``seed``, ``unit``,
        ``rows`` and ``asked`` (None: no number), ``shards`` and ``listed`` (files there and in all), ``missing``
        (names), ``changed`` (how, by name), ``workers`` (``host`` and ``pid`` of living processes), ``state``
        (complete, incomplete, running, starved, damaged) and ``next`` (what to do). Files that are in no run have an
        entry with state foreign, or unlisted where there is no manifest; a manifest that cannot be read one with state
        bad list.

    Raises:
        ShardError: A path is no folder, or there is neither a manifest nor a shard.
    """
    working = cache(workers)
    found: list[dict[str, Any]] = []
    for path in paths:
        if not path.is_dir():
            raise ShardError(f"{path}: no such folder")
        for folder, files in walk(path, hidden=False):
            if any(file == MANIFEST or file.endswith(SUFFIX) for file in files):
                found += _states(folder, working, verify)
    if not found:
        raise ShardError(f"no {MANIFEST} and no shard (*{SUFFIX}) in {', '.join(map(str, paths))}")
    return found


def _states(folder: Path, working: Any, verify: bool) -> list[dict[str, Any]]:
    files = sorted(folder.glob(f"*{SUFFIX}"))
    try:
        manifest = read_manifest(folder / MANIFEST)
    except ShardError as error:
        return [_loose(folder, len(files), "bad list") | {"problem": str(error)}]
    if manifest is None:
        return [_loose(folder, len(files), "unlisted")]
    found = compare(files, manifest, verify=verify)
    states = [_state(folder, run, found, working) for run in manifest.runs]
    return states + ([_loose(folder, len(found.foreign), "foreign")] if found.foreign else [])


def _loose(folder: Path, files: int, state: str) -> dict[str, Any]:
    return {"folder": str(folder), "shards": files, "state": state, "next": _NEXT[state]}


def _state(folder: Path, run: ListedRun, found: Differences, working: Any) -> dict[str, Any]:
    names = {shard.file for shard in run.shards}
    missing = {name for name in found.missing if name in names}
    changed = {name: how for name, how in found.changed.items() if name in names}
    there = [shard for shard in run.shards if shard.file not in missing]
    busy = [w for f in (folder, *folder.absolute().parents) for w in working(f) if w.run_key == run.run_key]
    if changed:
        state = "damaged"
    elif busy:
        state = "running"
    elif missing:
        state = "incomplete"
    else:
        starved = any(shard.asked is not None and (shard.rows or 0) < shard.asked for shard in there)
        state = "starved" if starved else "complete"
    # fewer may have been asked for since, of some shards none
    asked = sum(max(shard.asked or 0, shard.rows or 0) for shard in run.shards)
    return {
        "folder": str(folder),
        **run.model_dump(exclude={"shards"}),
        "rows": sum(shard.rows or 0 for shard in there),
        "asked": asked if any(shard.asked is not None for shard in run.shards) else None,
        "shards": sum(shard.written for shard in there),
        "listed": len(run.shards),
        "missing": sorted(missing),
        "changed": changed,
        "workers": [{"host": worker.host, "pid": worker.pid} for worker in busy],
        "state": state,
        "next": _NEXT.get(state, ""),
    }

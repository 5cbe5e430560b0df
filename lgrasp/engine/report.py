"""What a job did, in numbers: counted shard by shard from the files, so memory does not grow with the rows."""

import json
import os
import resource
import sys
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from lgrasp.dataset.files import new_file
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.folder import check_folder
from lgrasp.engine.registry import STAGES
from lgrasp.engine.shard import add_counts
from lgrasp.errors import OutputError
from lgrasp.grasp.duplicates import near_pairs
from lgrasp.jobs.generate import Job, Outcome

SEED_FSWO = 0.15
"""Squared frictionless residual below which the published system counts a grasp."""

_TALLY_THREADS = 4
_SURVIVORS = {
    "place": "kept",
    "domain": "rich",
    "ik": "kept",
    "search": "sets",
    "filter": "kept",
    "sequence": "kept",
    "validate": "held",
    "refine": "tried",
}


@dataclass
class _Tally:
    """Counts over shards on disk."""

    moving: np.ndarray  # (L,) which links of the hand are moved by a finger
    rows: int = 0
    seed_count: int = 0  # rows with >= 3 finger contacts and fswo^2 < SEED_FSWO
    near_duplicates: int = 0  # pairs inside a shard
    distinct_poses: int = 0
    counts: dict[str, dict[str, int]] = field(default_factory=dict)  # survivors as the stages report them

    def add(self, path: Path) -> None:
        """Count the rows of one shard.

        Raises:
            ShardError: the file is damaged.
        """
        with ShardReader(path) as reader:
            pose, q = reader.column("object_pose")[:, 0], reader.column("q")
            self.rows += len(reader)
            self.near_duplicates += len(near_pairs(pose, q))
            self.distinct_poses += len(np.unique(reader.column("candidate")))
            links = reader.column("contact_links")
            fingers = (self.moving[np.maximum(links, 0)] & (links >= 0)).sum((1, 2))
            fswo = reader.column("metrics/fswo")
            self.seed_count += int(((fingers >= 3) & (fswo**2 < SEED_FSWO)).sum())
            add_counts(self.counts, _stage_counts(reader.statistics))

    def merge(self, other: "_Tally") -> None:
        """Add the counts of other shards."""
        self.rows += other.rows
        self.seed_count += other.seed_count
        self.near_duplicates += other.near_duplicates
        self.distinct_poses += other.distinct_poses
        add_counts(self.counts, other.counts)


def _tally(paths: Iterable[Path], moving: np.ndarray) -> _Tally:
    """Counts over some shards, a few of them in memory at a time.

    Raises:
        ShardError: a file is damaged.
    """

    def one(path: Path) -> _Tally:
        tally = _Tally(moving)
        tally.add(path)
        return tally

    whole = _Tally(moving)
    with ThreadPoolExecutor(_TALLY_THREADS) as pool:
        for tally in pool.map(one, paths):
            whole.merge(tally)
    return whole


def _stage_counts(statistics: dict[str, Any]) -> dict[str, dict[str, int]]:
    counts: dict[str, dict[str, int]] = {}
    for key, value in statistics.items():
        stage, _, name = key.partition("_")
        if stage in STAGES and isinstance(value, int):
            counts.setdefault(stage, {})[name.replace("_", " ")] = value
    return counts


def survivors(counts: dict[str, dict[str, int]]) -> dict[str, int]:
    """One number per stage: poses, poses in reach, realised contacts (or sets), sets, grasps."""
    return {
        stage: found.get("sets" if stage == "ik" and "sets" in found else _SURVIVORS[stage], 0)
        for stage, found in counts.items()
    }


def report(job: Job, outcome: Outcome) -> dict[str, Any]:
    """The report of a job, JSON-serialisable; rates are those of the shards that this call made.

    Returns:
        ``grasps``, ``strict_valid_per_s``, ``seed_count_per_s`` (rows over the wall time of placement through filter),
        ``seconds`` (thread-seconds per stage; ``wall`` of placement through filter; hand, object, field, kernels,
        total), ``survivors`` and ``counts`` per stage, ``near_duplicates``, ``distinct_poses``, ``peak_rss_mb``,
        ``device``, ``peak_device_mb`` and what was asked.
    """
    tree = outcome.inputs.hand.model.tree
    moving = tree.body_group[tree.link_body] >= 0
    made = _tally(outcome.written, moving)
    present = _tally(set(outcome.paths) - set(outcome.written), moving)
    wall = sum(r.wall for r in outcome.results)
    counts: dict[str, dict[str, int]] = {stage: {} for stage in job.pipeline.order}
    seconds = dict.fromkeys(job.pipeline.order, 0.0)
    for result in outcome.results:
        add_counts(counts, result.counts)
        for stage, value in result.seconds.items():
            seconds[stage] += value
    if not outcome.results:
        counts |= present.counts
    inputs = outcome.inputs
    loading = {name: inputs.seconds.get(name, 0.0) for name in ("hand", "object", "field", "kernels")}
    return {
        "grasps": outcome.rows,
        "strict_valid_per_s": made.rows / wall if wall else 0.0,
        "seed_count_per_s": made.seed_count / wall if wall else 0.0,
        "seconds": seconds | loading | {"wall": wall, "total": outcome.wall},
        "survivors": survivors(counts),
        "near_duplicates": made.near_duplicates + present.near_duplicates,
        "distinct_poses": made.distinct_poses + present.distinct_poses,
        "peak_rss_mb": peak_rss_mb(),
        "device": inputs.device.name,
        "peak_device_mb": peak_device_mb(inputs.device.alias),
        "asked": job.rows,
        "made": outcome.made,
        "present": outcome.present,
        "seed_count": made.seed_count + present.seed_count,
        "counts": counts,
        "hits": inputs.hits,
        "hand": inputs.hand.model.name,
        "object": inputs.object.model.name,
        "pipeline": job.pipeline.name,
        "seed": job.pipeline.seed,
        "out": str(job.out),
        "shards": [path.name for path in outcome.paths],
        "starved": outcome.starved,
        "cancelled": outcome.cancelled,
    }


def peak_rss_mb() -> float:
    """Largest resident memory of this process so far [MB]."""
    try:
        with open("/proc/self/status", encoding="ascii") as file:
            kilobytes = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
        return kilobytes / 1000 * 1.024
    except (OSError, StopIteration):
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most / 1e6 if sys.platform == "darwin" else most * 1.024 / 1000


def peak_device_mb(device: str) -> float:
    """Largest memory that arrays held on a GPU so far [MB]; 0 on the CPU."""
    if not device.startswith("cuda") or not wp.is_mempool_enabled(device):
        return 0.0
    return wp.get_mempool_used_mem_high(device) / 1e6


def check_json(path: str | os.PathLike[str]) -> None:
    """Could a report be written there? To be asked before a long job.

    Raises:
        OutputError: it is a folder, or its folder cannot be written.
    """
    if Path(path).is_dir():
        raise OutputError(f"report {path} cannot be written: it is a folder; name a file")
    if _is_special(Path(path)):
        return
    try:
        check_folder(Path(path).parent)
    except OutputError as error:
        raise OutputError(f"report {path}: {str(error).replace('choose another with --out', 'name another')}") from None


def write_json(path: str | os.PathLike[str], data: Any) -> None:
    """Write JSON so that the file is whole or absent; a pipe or device such as /dev/stdout is written to.

    Raises:
        OutputError: the file cannot be written.
    """
    text = json.dumps(data, indent=2) + "\n"
    if _is_special(Path(path)):
        try:
            Path(path).write_text(text)
        except OSError as error:
            raise OutputError(f"report {path} cannot be written: {error.strerror}") from None
        return
    with new_file(path) as file:
        file.write(text.encode())


def _is_special(path: Path) -> bool:
    """Something that exists and is no regular file: it must not be replaced by one."""
    return path.exists() and not path.is_file()

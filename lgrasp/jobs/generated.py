"""Results of a job of grasps: counted shard by shard from the files, so memory does not grow with the rows."""

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.info import stage_counts, survivors
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.batch import PASS_BITS
from lgrasp.engine.run import JobOutcome
from lgrasp.engine.shard import add_counts, add_seconds
from lgrasp.grasp.bounds import GraspBounds, stored_bounds
from lgrasp.grasp.duplicates import near_pairs

PUBLISHED_FSWO = 0.15
"""Squared frictionless residual below which the published system counts a grasp."""

_TALLY_THREADS = 4


@dataclass
class _Tally:
    """Counts over shards on disk."""

    moving: np.ndarray  # (L,) which links of the hand are moved by a finger
    device: str  # where near-duplicates are looked for
    rows: int = 0
    strict: int = 0  # rows within the strict bounds, by their metrics
    published_count: int = 0  # rows with >= 3 finger contacts and fswo^2 < PUBLISHED_FSWO
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
            self.strict += _strict_rows(reader)
            self.near_duplicates += len(near_pairs(pose, q, self.device))
            self.distinct_poses += len(np.unique(reader.column("candidate") & ~PASS_BITS))
            links = reader.column("contact_links")
            fingers = (self.moving[np.maximum(links, 0)] & (links >= 0)).sum((1, 2))
            fswo = reader.column("metrics/fswo")
            self.published_count += int(((fingers >= 3) & (fswo**2 < PUBLISHED_FSWO)).sum())
            add_counts(self.counts, stage_counts(reader.statistics))

    def merge(self, other: "_Tally") -> None:
        """Add the counts of other shards."""
        self.rows += other.rows
        self.strict += other.strict
        self.published_count += other.published_count
        self.near_duplicates += other.near_duplicates
        self.distinct_poses += other.distinct_poses
        add_counts(self.counts, other.counts)


def _strict_rows(reader: ShardReader) -> int:
    """Rows within the strict bounds; none where friction was taken to be higher, since forces were balanced with it."""
    strict = GraspBounds()
    if stored_bounds(reader.header.config).friction > strict.friction:
        return 0
    return int(strict.met_by({name: reader.column(f"metrics/{name}") for name in strict.limits}).sum())


def _tally(paths: Iterable[Path], moving: np.ndarray, device: str) -> _Tally:
    """Counts over some shards, a few of them in memory at a time.

    Raises:
        ShardError: a file is damaged.
    """

    def one(path: Path) -> _Tally:
        tally = _Tally(moving, device)
        tally.add(path)
        return tally

    whole = _Tally(moving, device)
    with ThreadPoolExecutor(_TALLY_THREADS) as pool:
        for tally in pool.map(one, paths):
            whole.merge(tally)
    return whole


def generated_report(job: Any, outcome: JobOutcome) -> dict[str, Any]:
    """The numbers of a :class:`~lgrasp.jobs.generate.GenerateJob`; rates are those of the shards that this call made.

    Returns:
        ``grasps``, ``strict`` (those within the strict bounds) and ``profile`` (of the bounds that all are within);
        ``grasps_per_s``, ``strict_valid_per_s``, ``published_count_per_s`` (over the wall time of placement through
        filter),
        ``seconds`` (thread-seconds per stage; ``wall`` of placement through filter; hand, object, field),
        ``survivors`` and ``counts`` per stage, ``near_duplicates``, ``distinct_poses`` and what was asked.
    """
    inputs, order = job.inputs, job.pipeline.order
    tree = inputs.hand.model.tree
    moving = tree.body_group[tree.link_body] >= 0
    made = _tally(outcome.written, moving, inputs.device.alias)
    present = _tally(set(outcome.paths) - set(outcome.written), moving, inputs.device.alias)
    wall = sum(r.wall for r in outcome.results)
    counts: dict[str, dict[str, int]] = {stage: {} for stage in order}
    seconds = dict.fromkeys(order, 0.0)
    for result in outcome.results:
        add_counts(counts, result.counts)
        add_seconds(seconds, result.seconds)
    if not outcome.results:
        counts |= present.counts
    return {
        "grasps": outcome.rows,
        "strict": made.strict + present.strict,
        "profile": job.pipeline.bounds.profile,
        "grasps_per_s": made.rows / wall if wall else 0.0,
        "strict_valid_per_s": made.strict / wall if wall else 0.0,
        "published_count_per_s": made.published_count / wall if wall else 0.0,
        "seconds": seconds
        | {name: inputs.seconds.get(name, 0.0) for name in ("hand", "object", "field")}
        | {"wall": wall},
        "survivors": survivors(counts),
        "near_duplicates": made.near_duplicates + present.near_duplicates,
        "distinct_poses": made.distinct_poses + present.distinct_poses,
        "asked": job.rows,
        "published_count": made.published_count + present.published_count,
        "counts": counts,
        "hits": inputs.hits,
        "hand": inputs.hand.model.name,
        "object": inputs.object.model.name,
        "pipeline": job.pipeline.name,
        "seed": job.pipeline.seed,
    }

"""What is counted among the rows of shards: in memory as they are made, or in their files."""

from collections import Counter
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.info import stage_counts
from lgrasp.dataset.reader import ShardReader
from lgrasp.grasp.bounds import GraspBounds, measured_strictly
from lgrasp.grasp.duplicates import near_pairs
from lgrasp.grasp.pose_numbers import pose_numbers
from lgrasp.grasp.records import GraspRows
from lgrasp.runtime.tally import add_counts

PUBLISHED_FSWO = 0.15
"""Squared frictionless residual below which the program of Lightning Grasp counts a grasp (its paper tells none)."""

_MOST_COMPARED = 4_000_000
"""Rows of a folder among which near-duplicates are looked for: some 400 MB."""

_Column = Callable[[str], np.ndarray]
"""Values of the valid rows by flat name."""


def count_made(rows: GraspRows, config: Mapping[str, Any], moving: np.ndarray) -> Counter[str]:
    """``rows``, ``strict``, ``published_count``, ``closed`` (in force closure), ``distinct_poses``, ``negatives``, and
    on a table ``pose K`` for each plane K that the object rests on.

    Args:
        config: of the shard.
        moving: which links of the hand are moved by a finger, (L,).
    """
    columns, valid = rows.columns(), rows.valid
    found = _count(lambda name: columns[name][valid], columns, config, moving)
    return found + Counter(negatives=int((~valid).sum()))


def count_written(
    paths: Collection[Path], counted: Collection[Path], moving: np.ndarray, device: str
) -> tuple[Counter[str], dict[str, dict[str, int]], int]:
    """Counts of a folder's shards, each opened once.

    Args:
        counted: those that are counted already, by :func:`count_made`.
        moving: as there.
        device: that looks for near-duplicates.

    Returns:
        What :func:`count_made` counts, of the others; their survivors, as the stages report them; rows of all shards
        together that are near-duplicates of a row before them, of the first _MOST_COMPARED rows.

    Raises:
        ShardError: a file is damaged.
    """
    whole: Counter[str] = Counter()
    counts: dict[str, dict[str, int]] = {}
    poses, postures, compared = [], [], 0
    for path in paths:
        if path in counted and compared >= _MOST_COMPARED:
            continue
        with ShardReader(path, invalid=False) as reader:
            if path not in counted:
                whole.update(_count(reader.column, reader.columns, reader.header.config, moving))
                whole["negatives"] += int(reader.statistics.get("negatives", 0))
                add_counts(counts, stage_counts(reader.statistics))
            if compared < _MOST_COMPARED:
                poses.append(reader.column("object_pose")[:, 0])
                postures.append(reader.column("q"))
                compared += len(reader)
    near = near_pairs(np.concatenate(poses), np.concatenate(postures), device) if poses else np.zeros((0, 2), int)
    return whole, counts, len(np.unique(near[:, 1]))


def strict_rows(column: _Column, config: Mapping[str, Any]) -> int:
    """Rows within the strict bounds; none where friction was taken to be higher, since forces were balanced with it."""
    if not measured_strictly(config):
        return 0
    strict = GraspBounds()
    return int(strict.met_by({name: column(f"metrics/{name}") for name in strict.limits}).sum())


def _count(column: _Column, names: Collection[str], config: Mapping[str, Any], moving: np.ndarray) -> Counter[str]:
    links, fswo = column("contact_links"), column("metrics/fswo")
    fingers = (moving[np.maximum(links, 0)] & (links >= 0)).sum((1, 2))
    found = Counter(
        rows=len(fswo),
        strict=strict_rows(column, config),
        published_count=int(((fingers >= 3) & (fswo**2 < PUBLISHED_FSWO)).sum()),
        closed=int((column("metrics/epsilon") > 0).sum()),
        distinct_poses=len(np.unique(pose_numbers(column("candidate"), config))),
    )
    if "table/pose" in names:
        found.update(f"pose {k}" for k in column("table/pose").tolist())
    return found

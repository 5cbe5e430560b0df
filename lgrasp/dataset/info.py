"""The contents of shards, in one dictionary each, and survivors of stages, in one number each."""

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.reader import ShardReader


def describe(paths: Paths) -> list[dict[str, Any]]:
    """Summaries of shard files, or folders of them at any depth, JSON-serialisable, one per file.

    Returns:
        For each shard: ``file``, ``bytes``, ``rows``, ``invalid`` (rows of these with metric ``valid`` 0),
        ``rows_by_objects`` (rows by the number of objects held),
        ``rows_by_space`` (of sequences: rows by the opposition space of their last step; else None), ``hand``,
        ``objects`` (ids), ``pipeline``, ``grasp_type`` (asked for; else None), ``seed``, ``shard_index``, ``created``,
        ``lgrasp_version``, ``joints`` (names), ``columns`` (shape of each row dataset), ``metrics`` (unit, number
        of finite values, their min, mean and max; None if there are none) and ``statistics``.

    Raises:
        ShardError: No shard is found, or one cannot be read.
    """
    return [shard.value for shard in gather(paths, _describe)]


def closure_share(paths: Iterable[Path]) -> float | None:
    """Share of the rows of shards that have force closure (epsilon above 0); None if there are no rows.

    Raises:
        ShardError: One cannot be read.
    """
    closed = rows = 0
    for path in paths:
        with ShardReader(path, invalid=False) as reader:
            closed, rows = closed + int((reader.column("metrics/epsilon") > 0).sum()), rows + len(reader)
    return closed / rows if rows else None


def asked_type(config: Mapping[str, Any]) -> str | None:
    """The grasp type that all rows of a shard were asked for, None if none was."""
    steered = config.get("steered")
    asked = steered.get("grasp_type") if isinstance(steered, dict) else None
    return asked if isinstance(asked, str) else None


def _describe(reader: ShardReader) -> dict[str, Any]:
    header = reader.header
    units = reader.rows(0, 0).metric_units
    held, by_space = (reader.column("object_index") >= 0).sum(1), None
    if reader.space_names is not None:
        last = np.take_along_axis(reader.column("sequence/space"), held[:, None] - 1, 1)
        by_space = {name: int((last == number).sum()) for number, name in enumerate(reader.space_names)}
    return {
        "file": str(reader.path),
        "bytes": reader.path.stat().st_size,
        "rows": len(reader),
        "invalid": int((reader.column("metrics/valid") == 0).sum()) if "metrics/valid" in reader.columns else 0,
        "rows_by_objects": {str(n): int(rows) for n, rows in enumerate(np.bincount(held)) if rows},
        "rows_by_space": by_space,
        "hand": str(reader.attributes["hand"]),
        "objects": reader.object_ids,
        "pipeline": header.pipeline,
        "grasp_type": asked_type(header.config),
        "seed": header.seed,
        "shard_index": header.shard_index,
        "created": header.created,
        "lgrasp_version": header.lgrasp_version,
        "joints": list(reader.hand().joint_names),
        "columns": {name: list(shape) for name, (shape, _) in reader.columns.items()},
        "metrics": {n: {"unit": unit, **_range(reader.column(f"metrics/{n}"))} for n, unit in units.items()},
        "statistics": reader.statistics,
    }


def _range(values: np.ndarray) -> dict[str, float | None]:
    values = values[np.isfinite(values)].astype(np.float64)
    ends = {"min": np.min, "mean": np.mean, "max": np.max}
    return {"finite": len(values)} | {n: float(end(values)) if len(values) else None for n, end in ends.items()}


def pooled(shards: Iterable[Mapping[str, Any]]) -> dict[tuple[str, str], dict[str, Any]]:
    """``metrics`` of several shards of :func:`describe` together, by name and unit."""
    found: dict[tuple[str, str], list[Mapping[str, Any]]] = {}
    for shard in shards:
        for name, values in shard["metrics"].items():
            found.setdefault((name, values["unit"]), []).append(values)
    return {key: _together([v for v in values if v["finite"]]) for key, values in found.items()}


def _together(ranges: list[Mapping[str, Any]]) -> dict[str, Any]:
    finite = sum(r["finite"] for r in ranges)
    return {
        "finite": finite,
        "min": min((r["min"] for r in ranges), default=None),
        "mean": sum(r["mean"] * r["finite"] for r in ranges) / finite if finite else None,
        "max": max((r["max"] for r in ranges), default=None),
    }


Counts = dict[str, dict[str, int]]
"""Stage -> what is counted -> number."""

SURVIVORS = {
    "place": "kept",
    "domain": "rich",
    "ik": "kept",
    "wrap": "wrapped",
    "close": "touching",
    "search": "sets",
    "adjust": "kept",
    "filter": "kept",
    "refine": "tried",
    "hold": "held",
    "sequence": "kept",
    "simulate": "held",
}
"""The count of a stage that says how many came through."""

_OLD_NAMES = {"validate": "simulate"}
"""Stages as shards of 0.1 name them."""


def survivors(counts: Counts) -> dict[str, int]:
    """One number per stage: poses, poses in reach, realised contacts (or sets), sets, grasps."""
    return {
        stage: found.get("sets" if stage == "ik" and "sets" in found else SURVIVORS[stage], 0)
        for stage, found in counts.items()
    }


def last_survivors(counts: Counts) -> int:
    """Grasps that came through the last of the stages that leave some out."""
    left = survivors(counts)
    return next((left[stage] for stage in ("simulate", "hold", "filter") if stage in left), 0)


def stage_counts(statistics: Mapping[str, Any]) -> Counts:
    """Counts by stage from the statistics of a shard (``STAGE_NAME``)."""
    counts: Counts = {}
    for key, value in statistics.items():
        stage, _, name = key.partition("_")
        stage = _OLD_NAMES.get(stage, stage)
        if stage in SURVIVORS and isinstance(value, int):
            counts.setdefault(stage, {})[name.replace("_", " ")] = value
    return counts

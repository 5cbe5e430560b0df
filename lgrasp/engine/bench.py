"""Pipelines side by side on several objects, in one run on one device."""

import tempfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from statistics import median
from typing import Any

from lgrasp.engine.cache import Cache
from lgrasp.engine.generate import Job, generate
from lgrasp.engine.report import report

__all__ = ["bench"]

_MEASURED = ("strict_valid_per_s", "seed_count_per_s")


def bench(jobs: list[Job], repeat: int, progress: Callable[[str], None] | None = None) -> list[dict[str, Any]]:
    """Run each job ``repeat`` times, in turns, and report the middle and the spread.

    Inputs are made once in a temporary cache, which gives their building time, and loaded from it after; shards go
    to a temporary folder. Nothing is left behind.

    Args:
        jobs: what is compared; their folders and caches are not used.
        progress: called with one line before each run.

    Returns:
        For each job ``pipeline``, ``hand``, ``object``, ``grasps``, ``device``; each rate as ``median``, ``min``,
        ``max``; ``seconds`` and ``survivors`` of the middle run; ``build_seconds`` and ``load_seconds`` of
        object and field; ``near_duplicates``, ``distinct_poses``, ``starved``, ``peak_rss_mb``.

    Raises:
        LgraspError: bad input.
    """
    runs: list[list[dict[str, Any]]] = [[] for _ in jobs]
    built: dict[str, dict[str, float]] = {"object": {}, "field": {}}
    with tempfile.TemporaryDirectory(prefix="lgrasp-bench-") as folder:
        cache = Cache(Path(folder) / "cache")
        for turn in range(repeat):
            for number, job in enumerate(jobs):
                if progress:
                    progress(
                        f"run {turn + 1}/{repeat}: {job.pipeline.name}, {Path(job.object).stem}, {job.rows:,} rows"
                    )
                with tempfile.TemporaryDirectory(dir=folder) as out:
                    trial = replace(job, out=Path(out), cache=cache, resume=False)
                    outcome = generate(trial)
                    data = report(trial, outcome)
                for kind, made in built.items():
                    if not outcome.inputs.hits[kind]:
                        made[getattr(outcome.inputs.keys, kind)] = data["seconds"][kind]
                data["keys"] = {kind: getattr(outcome.inputs.keys, kind) for kind in built}
                runs[number].append(data)
    return [_summary(found, built) for found in runs]


def _summary(runs: list[dict[str, Any]], built: dict[str, dict[str, float]]) -> dict[str, Any]:
    middle = sorted(runs, key=lambda data: data["strict_valid_per_s"])[len(runs) // 2]
    same = ("pipeline", "hand", "object", "grasps", "device", "survivors", "counts")
    last = ("near_duplicates", "distinct_poses", "starved", "peak_device_mb")
    return {
        **{name: middle[name] for name in same},
        **{name: _spread([data[name] for data in runs]) for name in _MEASURED},
        "seconds": middle["seconds"],
        "build_seconds": {kind: built[kind].get(key, 0.0) for kind, key in middle["keys"].items()},
        "load_seconds": {kind: min(data["seconds"][kind] for data in runs) for kind in built},
        **{name: middle[name] for name in last},
        "peak_rss_mb": max(data["peak_rss_mb"] for data in runs),
    }


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": median(values), "min": min(values), "max": max(values)}

"""Pipelines side by side on several objects, in one run on one device."""

from collections.abc import Callable
from pathlib import Path
from statistics import median_low
from typing import Any

from lgrasp.engine.cache import Cache
from lgrasp.engine.report import job_report
from lgrasp.engine.run import run
from lgrasp.files import temporary_folder
from lgrasp.jobs.generate import GenerateJob

_MEASURED = ("strict_valid_per_s", "published_count_per_s")
_INPUTS = ("object", "field")
_PROBE_ROWS = 256  # and at most a tenth of the rows
Built = dict[tuple[str, str], float]
"""Seconds that making each input took, by kind and content key."""


def measure(
    jobs: list[GenerateJob], repeat: int, cache: Cache, built: Built, say: Callable[[str], None] = lambda line: None
) -> list[dict[str, Any]]:
    """Run each job ``repeat`` times, in turns, and report the middle and the spread; nothing is left but the cache.

    A small untimed run comes first: it makes the inputs, loads the kernels and measures the rows kept per candidate, by
    which a GPU's first batch is sized. Every run passes its own yield to the next one of its job, as the shards of a
    long run do.

    Args:
        jobs: what is compared; their folders and caches are not used.
        cache: where hands, objects and fields are made once, and then loaded from.

    Returns:
        For each job ``pipeline``, ``hand``, ``object``, ``grasps``, ``strict``, ``profile``, ``device``; each rate as
        ``median``, ``min``, ``max``; ``seconds`` and ``survivors`` of the middle run (of two, the slower);
        ``build_seconds`` and ``load_seconds`` of object and field; ``near_duplicates``, ``distinct_poses``,
        ``starved``, ``peak_rss_mb``.

    Raises:
        LgraspError: bad input.
    """
    jobs, runs = list(jobs), [[] for _ in jobs]
    for turn in range(repeat + 1):
        for number, job in enumerate(jobs):
            rows = job.rows if turn else max(1, min(_PROBE_ROWS, job.rows // 10))
            what = f"run {turn}/{repeat}" if turn else "untimed"
            say(f"{what}: {job.pipeline.name}, {Path(job.object).stem}, {rows:,} rows")
            cache.more_jobs = (turn, number) != (repeat, len(jobs) - 1)
            data, rate = _run(job.changed(rows=rows, cache=cache), built)
            jobs[number] = job.changed(rate=rate)
            runs[number] += [data] if turn else []
    return [_summary(found, built) for found in runs]


def _run(job: GenerateJob, built: Built) -> tuple[dict[str, Any], float]:
    """The report of a job, and its rows per candidate."""
    with temporary_folder() as out:
        outcome = run(job.changed(out=out), resume=False)
        data = job_report(outcome)
    data["keys"] = {kind: getattr(outcome.job.inputs.keys, kind) for kind in _INPUTS}
    for kind, key in data["keys"].items():
        if not outcome.job.inputs.hits[kind]:
            built[kind, key] = data["seconds"][kind]
    return data, outcome.job.measured_rate


def _summary(runs: list[dict[str, Any]], built: Built) -> dict[str, Any]:
    middle = sorted(runs, key=lambda data: data["strict_valid_per_s"])[(len(runs) - 1) // 2]
    same = ("pipeline", "hand", "object", "grasps", "strict", "profile", "device", "survivors", "counts")
    last = ("near_duplicates", "distinct_poses", "starved", "peak_device_mb")
    return {
        **{name: middle[name] for name in same},
        **{name: _spread([data[name] for data in runs]) for name in _MEASURED},
        "seconds": middle["seconds"],
        "build_seconds": {kind: built.get((kind, key), 0.0) for kind, key in middle["keys"].items()},
        "load_seconds": {kind: min(data["seconds"][kind] for data in runs) for kind in _INPUTS},
        **{name: middle[name] for name in last},
        "peak_rss_mb": max(data["peak_rss_mb"] for data in runs),
    }


def _spread(values: list[float]) -> dict[str, float]:
    return {"median": median_low(values), "min": min(values), "max": max(values)}

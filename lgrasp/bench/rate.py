"""Pipelines side by side on several objects, in one run on one device."""

from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import JobOutcome
from lgrasp.engine.report import job_report
from lgrasp.files import temporary_folder
from lgrasp.jobs.generate import GenerateJob, generate

_MEASURED = ("strict_valid_per_s", "published_count_per_s")
_INPUTS = ("object", "field")
_PROBE_ROWS = 256  # and at most a tenth of the rows
Progress = Callable[[str], None]


class Bench:
    """Runs jobs in a temporary folder and cache; nothing is left behind when the block ends.

    Hands, objects and fields are made once, which gives their building time, and loaded from the temporary cache after.
    """

    def __init__(self) -> None:
        self._built: dict[str, dict[str, float]] = {kind: {} for kind in _INPUTS}

    def __enter__(self) -> "Bench":
        self._held = temporary_folder()
        self._folder = self._held.__enter__()
        self._cache = Cache(self._folder / "cache")
        return self

    def __exit__(self, *error: Any) -> None:
        self._held.__exit__(*error)

    def measure(self, jobs: list[GenerateJob], repeat: int, progress: Progress | None = None) -> list[dict[str, Any]]:
        """Run each job ``repeat`` times, in turns, and report the middle and the spread.

        A small untimed run comes first: it makes the inputs, loads the kernels and measures the rows kept per
        candidate, by which a GPU's first batch is sized. Every run passes its own yield to the next one of its job, as
        the shards of a long run do.

        Args:
            jobs: what is compared; their folders and caches are not used.
            progress: called with one line before each run.

        Returns:
            For each job ``pipeline``, ``hand``, ``object``, ``grasps``, ``strict``, ``profile``, ``device``; each rate
            as ``median``, ``min``, ``max``; ``seconds`` and ``survivors`` of the middle run; ``build_seconds`` and
            ``load_seconds`` of object and field; ``near_duplicates``, ``distinct_poses``, ``starved``, ``peak_rss_mb``.

        Raises:
            LgraspError: bad input.
        """
        say = progress or (lambda line: None)
        jobs = [self._probed(job, say) for job in jobs]
        runs: list[list[dict[str, Any]]] = [[] for _ in jobs]
        for turn in range(repeat):
            for number, job in enumerate(jobs):
                say(f"run {turn + 1}/{repeat}: {job.pipeline.name}, {Path(job.object).stem}, {job.rows:,} rows")
                data, outcome = self._run(job)
                jobs[number] = job.changed(rate=outcome.job.measured_rate)
                runs[number].append(data)
        return [_summary(found, self._built) for found in runs]

    def _probed(self, job: GenerateJob, say: Progress) -> GenerateJob:
        """The job with the rows per candidate of a run of a few rows."""
        rows = max(1, min(_PROBE_ROWS, job.rows // 10))
        say(f"untimed: {job.pipeline.name}, {Path(job.object).stem}, {rows:,} rows")
        _, outcome = self._run(job.changed(rows=rows))
        return job.changed(rate=outcome.job.measured_rate)

    def _run(self, job: GenerateJob) -> tuple[dict[str, Any], JobOutcome]:
        with temporary_folder() as out:
            outcome = generate(job.changed(out=out, cache=self._cache), resume=False)
            data = job_report(outcome)
        data["keys"] = {kind: getattr(outcome.job.inputs.keys, kind) for kind in _INPUTS}
        for kind, key in data["keys"].items():
            if not outcome.job.inputs.hits[kind]:
                self._built[kind][key] = data["seconds"][kind]
        return data, outcome


def _summary(runs: list[dict[str, Any]], built: dict[str, dict[str, float]]) -> dict[str, Any]:
    middle = sorted(runs, key=lambda data: data["strict_valid_per_s"])[len(runs) // 2]
    same = ("pipeline", "hand", "object", "grasps", "strict", "profile", "device", "survivors", "counts")
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

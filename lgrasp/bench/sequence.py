"""The tables of SeqGrasp, measured: success by opposition space and by number of objects, for several methods."""

from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from lgrasp.bench.page import Page, Table, caveats, load_published, number, over, times
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.shard import add_counts
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.hand.opposition.spaces import consumed
from lgrasp.jobs.records import make_scene, mesh_blobs
from lgrasp.jobs.sequence.inputs import SequenceInputs, load_sequence_inputs
from lgrasp.jobs.sequence.job import SequenceJob, simulated
from lgrasp.jobs.sequence.records import object_records
from lgrasp.jobs.sequence.round import Verdicts, run_round
from lgrasp.runtime.cores import threads
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels

_RATES = ("held_per_s", "strict_per_s")
_SHARE = ".1f", " %"


def bench_methods(
    jobs: list[SequenceJob],
    methods: Sequence[str],
    baseline_width: int,
    progress: Callable[[str], None],
    drawn: Sequence[SequenceJob] = (),
) -> dict[str, Any]:
    """Run each method on the same sequences of objects; methods after the first with ``baseline_width`` attempts.

    Args:
        drawn: the same sequences drawn by a network, measured as a method more with all their attempts.

    Returns:
        ``published``; ``device``, ``simulate`` and ``sequences`` as asked; ``methods``: name -> see
        :func:`measure_sequences`, with the ``ratios`` of the first method to it, by rows per second.
    """
    found: dict[str, dict[str, Any]] = {}
    for method in methods:
        changes: dict[str, Any] = {"method": method} | ({"width": baseline_width} if found else {})
        own = [job.changed(pipeline=job.pipeline.with_params("sequence", **changes)) for job in jobs]
        found[method] = measure_sequences(own, progress)
    if drawn:
        found["diffuser"] = measure_sequences(list(drawn), progress)
    first = next(iter(found.values()))["objects"]
    for one in found.values():
        one["ratios"] = [
            {name: over(a[name], b[name]) for name in _RATES} for a, b in zip(first, one["objects"], strict=True)
        ]
    return {
        "published": load_published("seqgrasp").model_dump(mode="json"),
        "device": resolve_device(jobs[0].device).name,
        "sequences": [list(job.objects) for job in jobs],
        "simulate": jobs[0].simulate,
        "methods": found,
    }


def measure_sequences(jobs: list[SequenceJob], progress: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Run a round of each job, simulate every row and continue those that hold; nothing is written.

    Grasps of an optimiser are simulated as published: only a penetration of 1 cm, contacts farther away than that, and
    links in links are left out before.

    Args:
        jobs: the same method on several sequences of objects; each names a protocol.
        progress: called with one line before each round.

    Returns:
        ``begun`` (attempts of each sequence), ``spaces`` (name -> sequences tried with it, rows found, rows that held)
        and ``objects`` (for each number of objects, see :class:`_Objects`).
    """
    device, bounds = resolve_device(jobs[0].device), jobs[0].pipeline.bounds
    spaces: dict[str, dict[str, int]] = {}
    objects = [_Objects() for _ in range(max(len(job.objects) for job in jobs))]
    for job in jobs:
        pipeline, cache, keys = _as_published(job.pipeline), job.cache, job.keys
        inputs = load_sequence_inputs(cache, keys, pipeline.object, pipeline.field, device)
        scene = make_scene(cache, inputs.hand, object_records(inputs), mesh_blobs(keys.source.urdf), device.alias)
        inputs = job.with_sampler(replace(inputs, scene=scene))
        load_kernels(device.alias, kernel_modules(*job.kernels))
        assert job.simulate
        params = pipeline.params("sequence")
        if progress:
            progress(f"{params.method}, {' '.join(inputs.object_ids)}: {params.width} attempts")
        seen: list[SequenceTable] = []
        watched = _watched(simulated(inputs, job.simulate), seen)
        found = run_round(pipeline, inputs, 0, 0, threads(job.workers), verdicts=watched)
        for name, counts in ((name, counts) for step in found.spaces for name, counts in step.items()):
            grown, ran = counts.get("sequence", {}), counts.get("simulate", {})
            more = {"tried": grown.get("sequences", 0), "found": ran.get("tried", 0), "held": ran.get("held", 0)}
            add_counts(spaces, {name: more})
        attempts = [params.width, *map(len, found.levels)]
        for step, entry in enumerate(objects):
            entry.begun += params.width
            entry.attempts += attempts[step] if step < len(attempts) else 0
            entry.seconds += sum(found.walls[step : step + 1])
            entry.total += sum(found.walls[: step + 1])
        for step, table in enumerate(seen):
            objects[step].add(table, found.levels[step], inputs, int(bounds.met_by(table.metrics).sum()))
    begun = jobs[0].pipeline.params("sequence").width
    return {"begun": begun, "spaces": spaces, "objects": [entry.summary() for entry in objects]}


def _as_published(pipeline: Pipeline) -> Pipeline:
    """The pipeline; for an optimiser with the published bounds in place of those of strict validity."""
    if pipeline.params("sequence").method in ("field", "diffuser"):
        return pipeline
    return pipeline.with_bounds(
        max_penetration=0.01, min_self_distance=0.0, max_gap=0.01, max_normal_angle=60.0, max_gswo=1.0
    )


def _watched(simulate: Verdicts, seen: list[SequenceTable]) -> Verdicts:
    """The same simulation; the rows that it is given are kept."""

    def run(levels: list[SequenceTable]) -> dict[str, np.ndarray]:
        seen.append(levels[-1])
        return simulate(levels)

    return run


class _Objects:
    """Rows of one number of objects, over the sequences."""

    def __init__(self) -> None:
        self.begun = self.attempts = 0  # with the first object; with this one, after rows that held
        self.seconds = self.total = 0.0  # of this step; of it and those before; simulation not counted
        self._rows: Counter[str] = Counter()
        self._depth: list[float] = []
        self._q: list[np.ndarray] = []

    def add(self, tried: SequenceTable, held: SequenceTable, inputs: SequenceInputs, strict: int) -> None:
        """Count rows: those simulated, those of them that held, and how many were strict."""
        pairs = zip(held.space, held.used, strict=True)
        full = sum(consumed(inputs.spaces, frozenset(s.tolist()), used) for s, used in pairs)
        self._rows.update(simulated=len(tried), strict=strict, held=len(held), consumed=full)
        self._depth += (1e3 * tried.metrics["penetration"]).tolist()
        self._q += [*held.q[:, -1]]

    def summary(self) -> dict[str, Any]:
        """The numbers.

        Returns:
            Counts; shares that hold [%]: of all attempts begun (``success``), of those that reached this step, of the
            rows simulated; rows per second of all steps so far; ``penetration_*`` [mm] of the rows simulated;
            ``diversity``, the standard deviation of the joints of held rows [rad].
        """
        depth, rows = self._depth, self._rows
        return {
            "begun": self.begun,
            "attempts": self.attempts,
            **{name: rows[name] for name in ("simulated", "strict", "held")},
            "success": _percent(rows["held"], self.begun),
            "success_of_attempts": _percent(rows["held"], self.attempts),
            "success_of_simulated": _percent(rows["held"], rows["simulated"]),
            "consumed": _percent(rows["consumed"], rows["held"]),
            "penetration_mean": float(np.mean(depth)) if depth else None,
            "penetration_median": float(np.median(depth)) if depth else None,
            "penetration_max": max(depth) if depth else None,
            "seconds": self.seconds,
            "seconds_per_256": over(256 * self.seconds, self.attempts),
            "held_per_s": over(rows["held"], self.total),
            "strict_per_s": over(rows["strict"], self.total),
            "diversity": float(np.std(self._q, axis=0).mean()) if len(self._q) > 1 else None,
        }


def _percent(part: int, whole: int) -> float | None:
    return over(100.0 * part, whole)


def sequence_page(result: dict[str, Any]) -> Page:
    """The tables as texts; published figures stand in parentheses beside what is counted as they are."""
    published, count = result["published"]["figures"], len(result["sequences"])
    head = [f"{result['device']}: {count} sequence{'s' if count > 1 else ''} of objects; protocol {result['simulate']}"]
    tables = []
    for method, found in result["methods"].items():
        title = f"{method}: {found['begun']} attempts started with each sequence"
        tables += [_space_table(title, found["spaces"], published["spaces"])]
        tables += _object_tables(found["objects"], published | published.get(method, {}))
    tables.append(_rate_table(result))
    notes = [
        "hold/tried, hold/begun: of all attempts, as published; the other shares are of what was left of them",
        "(...): published; strict: rows within the bounds of the pipeline, whether they hold or not",
        *caveats(result["published"]),
    ]
    return Page(head, tables, notes)


def _space_table(title: str, spaces: dict[str, dict[str, int]], published: dict[str, float]) -> Table:
    rows = [
        (
            name,
            *(number(counts[key]) for key in ("tried", "found", "held")),
            number(_percent(counts["held"], counts["tried"]), *_SHARE),
            number(published.get(name), *_SHARE),
            number(_percent(counts["held"], counts["found"]), *_SHARE),
        )
        for name, counts in spaces.items()
    ]
    return Table(title, ("space", "tried", "found", "hold", "hold/tried", "published", "hold/found"), rows)


def _object_tables(entries: list[dict[str, Any]], published: dict[str, list[float]]) -> list[Table]:
    """Shares and measures by number of objects."""
    shares, measures = [], []
    for n, entry in enumerate(entries):
        shares.append(
            (
                str(n + 1),
                *(number(entry[key]) for key in ("begun", "attempts", "simulated", "strict", "held")),
                _beside(entry["success"], published["success"], n, *_SHARE),
                *(number(entry[key], *_SHARE) for key in ("success_of_attempts", "success_of_simulated")),
            )
        )
        measures.append(
            (
                str(n + 1),
                _beside(entry["penetration_mean"], published["penetration"], n, ".2f"),
                *(number(entry[key], ".2f") for key in ("penetration_median", "penetration_max")),
                _beside(entry["consumed"], published["consumed"], n, *_SHARE),
                _beside(entry["seconds_per_256"], published["seconds_per_256"], n, ".1f"),
                _beside(entry["diversity"], published["diversity"], n, ".3f"),
            )
        )
    of = ("objects", "begun", "attempts", "simulated", "strict", "hold", "hold/begun", "hold/attempts", "hold/sim")
    by = ("objects", "penetration: mean mm", "median", "largest", "consumed", "s per 256 attempts", "diversity")
    return [Table("", of, shares), Table("", by, measures)]


def _rate_table(result: dict[str, Any]) -> Table:
    """Rows per second of each method and of the paper, by what counts as a row; the first method over the others."""
    first = next(iter(result["methods"]))
    columns = ("objects", "method", "hold/s", "strict/s", f"{first}/it, hold", f"{first}/it, strict")
    rows = []
    figures = result["published"]["figures"]
    for n in range(max(len(found["objects"]) for found in result["methods"].values())):
        for method, found in result["methods"].items():
            rates = [number(found["objects"][n][name], ",.3g") for name in _RATES]
            ratios = [times(found["ratios"][n][name]) for name in _RATES]
            rows.append((str(n + 1), method, *rates, *(ratios if method != first else ("", ""))))
        if n < len(figures["success"]):
            seconds = sum(figures["seconds_per_256"][: n + 1])
            held = 256 * figures["success"][n] / 100 / seconds
            ratio = over(result["methods"][first]["objects"][n]["held_per_s"], held)
            rows.append((str(n + 1), "published", f"{held:,.3g}", "-", times(ratio), "-"))
    return Table("rows per second, all steps so far, simulation not counted", columns, rows, 2)


def _beside(ours: float | None, theirs: list[float], n: int, form: str, unit: str = "") -> str:
    return f"{number(ours, form, unit)} ({number(theirs[n] if n < len(theirs) else None, form, unit)})"

"""The tables of SeqGrasp, measured: success by opposition space and by number of objects, for several methods."""

import json
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.bench.page import Page, Table, caveats, check_once, load_published, over, times
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.shard import add_counts
from lgrasp.errors import ConfigError
from lgrasp.geometry.poses import device_matrix
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.hand.opposition.spaces import available
from lgrasp.jobs.records import make_scene, mesh_blobs
from lgrasp.jobs.sequence.inputs import SequenceInputs, load_sequence_inputs
from lgrasp.jobs.sequence.job import SequenceJob, simulated
from lgrasp.jobs.sequence.records import object_records
from lgrasp.jobs.sequence.round import Verdicts, run_round
from lgrasp.runtime.cores import threads
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels
from lgrasp.words import number, plural

_RATES = ("held_per_s", "strict_per_s")
_SHARE = ".1f", " %"


def bench_methods(
    jobs: list[SequenceJob],
    methods: Sequence[str],
    baseline_width: int,
    progress: Callable[[str], None],
    drawn: Sequence[SequenceJob] = (),
    parts: dict[str, Any] | None = None,
) -> Iterator[dict[str, Any]]:
    """Run each method on the same sequences of objects; methods after the first with ``baseline_width`` attempts.

    Args:
        drawn: the same sequences drawn by a network, with all their attempts: method ``diffuser``, and ``diffuser
            unrefined``, one draw of each attempt as it comes.
        parts: measured before, by the keys of their jobs; those that are measured join them.

    Yields:
        After each method and sequence, all methods of one sequence before the next: ``published``; ``device``,
        ``simulate`` and ``sequences`` as asked; ``parts``; ``methods``: name -> see :func:`summary`, of the sequences
        so far, with the ``ratios`` of the first method to it, by rows per second.

    Raises:
        ConfigError: a method is named twice.
        PhysicsError: the simulator is not installed.
    """
    check_once("method", list(methods))
    jobs[0].check_simulator()
    parts = {} if parts is None else parts
    asked: dict[str, list[SequenceJob]] = {}
    for method in methods:
        changes: dict[str, Any] = {"method": method} | ({"width": baseline_width} if asked else {})
        asked[method] = [job.changed(pipeline=job.pipeline.with_params("sequence", **changes)) for job in jobs]
        if method == methods[0] and drawn:
            asked["diffuser"] = list(drawn)
            asked["diffuser unrefined"] = [
                job.changed(pipeline=job.pipeline.with_params("sequence", refined=False)) for job in drawn
            ]
    result: dict[str, Any] = {
        "published": load_published("seqgrasp").model_dump(mode="json"),
        "device": resolve_device(jobs[0].device).name,
        "sequences": [list(job.objects) for job in jobs],
        "simulate": jobs[0].simulate,
        "parts": parts,
        "methods": {},
    }
    done: dict[str, list[dict[str, Any]]] = {}
    for place in range(len(jobs)):
        for name, own in asked.items():
            key = own[place].key()
            if parts.get(key, {}).get("device") != result["device"]:
                width = own[place].pipeline.params("sequence").width
                progress(f"{place + 1}/{len(jobs)} {name}, {' '.join(own[place].objects)}: {width} attempts")
                parts[key] = measure_sequence(own[place], result["device"])
            done.setdefault(name, []).append(parts[key])
            result["methods"] = {method: summary(some) for method, some in done.items()}
            first = next(iter(result["methods"].values()))["objects"]
            for one in result["methods"].values():
                pairs = zip(first, one["objects"], strict=True)
                one["ratios"] = [{rate: over(a[rate], b[rate]) for rate in _RATES} for a, b in pairs]
            yield result


def measure_sequence(job: SequenceJob, device: str) -> dict[str, Any]:
    """Run a round of a job, simulate every row and continue those that hold; nothing is written.

    Grasps of an optimiser, and of a network as they are drawn, are simulated unless they penetrate by 1 cm (hand or
    objects), as published, a contact is farther off than 5 cm, or links are in links.

    Returns:
        ``begun`` (attempts), ``device``, ``spaces`` (name -> sequences tried with it, rows found, rows that held) and
        ``steps``: for each object counts, ``seconds`` (simulation not counted), ``drawn`` candidates, ``outcomes`` of
        the filter, ``depth`` (penetration of each row simulated [mm]), and sums of the numbers of held grasps and of
        their squares.
    """
    used, bounds = resolve_device(job.device), job.pipeline.bounds
    pipeline, cache, keys = _as_published(job.pipeline), job.cache, job.keys
    inputs = load_sequence_inputs(cache, keys, pipeline.object, pipeline.field, used)
    scene = make_scene(cache, inputs.hand, object_records(inputs), mesh_blobs(keys.source.urdf))
    inputs = job.with_sampler(replace(inputs, scene=scene))
    load_kernels(used.alias, kernel_modules(*job.kernels))
    assert job.simulate
    width, seen = pipeline.params("sequence").width, []
    watched = _watched(simulated(inputs, job.simulate), seen)
    found = run_round(pipeline, inputs, 0, 0, threads(job.workers), verdicts=watched)
    spaces: dict[str, dict[str, int]] = {}
    for name, counts in ((name, counts) for step in found.spaces for name, counts in step.items()):
        more = {"tried": counts["sequences"], "found": counts.get("simulated", 0), "held": counts.get("stable", 0)}
        add_counts(spaces, {name: more})
    attempts, steps = [width, *map(len, found.levels)], []
    for step in range(len(job.objects)):
        counts = found.steps[step] if step < len(found.steps) else {}
        entry = {
            "attempts": attempts[step] if step < len(attempts) else 0,
            "seconds": sum(found.walls[step : step + 1]),
        }
        entry |= {"drawn": counts.get("place", {}).get("tried", 0), "outcomes": counts.get("filter", {})}
        tried, held = (some[step] if step < len(some) else None for some in (seen, found.levels))
        steps.append(entry | _rows(tried, held, inputs, bounds))
    return {"begun": width, "device": device, "spaces": spaces, "steps": steps}


def _rows(
    tried: SequenceTable | None, held: SequenceTable | None, inputs: SequenceInputs, bounds: GraspBounds
) -> dict[str, Any]:
    """Counts and numbers of the rows that were simulated, and of those of them that held."""
    if tried is None or held is None:
        return {"simulated": 0, "strict": 0, "held": 0, "consumed": 0, "depth": [], "sum": [], "squares": []}
    pairs = zip(held.space, held.used, strict=True)
    full = sum(not available(inputs.spaces, frozenset(s.tolist()), used) for s, used in pairs)
    R, t = device_matrix(held.pose[:, -1])[:, :3, :2], held.pose[:, -1, :3]
    grasps = np.concatenate([t, R.reshape(-1, 6), held.q[:, -1]], 1).astype(float)
    return {
        "simulated": len(tried),
        "strict": int(bounds.met_by(tried.metrics).sum()),
        "held": len(held),
        "consumed": full,
        "depth": np.round(1e3 * tried.metrics["penetration"], 4).tolist(),
        "sum": grasps.sum(0).tolist(),
        "squares": (grasps**2).sum(0).tolist(),
    }


def summary(parts: list[dict[str, Any]]) -> dict[str, Any]:
    """The numbers of one method over several sequences of objects.

    Returns:
        ``begun`` (attempts of each sequence), ``spaces``, and ``objects``: for each number of objects counts; shares
        that hold [%]: of all attempts begun (``success``), of those that reached this step, of the rows simulated; rows
        per second of all steps so far; ``penetration_*`` [mm] of the rows simulated; ``diversity``: the standard
        deviation of held grasps, mean over position [m], rotation in 6D and joints [rad]; ``drawn_per_attempt`` and
        ``passed`` (share of the candidates drawn that pass the filter [%]); ``outcomes`` of the filter.
    """
    spaces: dict[str, dict[str, int]] = {}
    objects, total = [], 0.0
    for part in parts:
        add_counts(spaces, part["spaces"])
    begun = sum(part["begun"] for part in parts)
    for entries in zip_longest(*(part["steps"] for part in parts)):
        steps = [entry for entry in entries if entry]
        names = ("attempts", "simulated", "strict", "held", "consumed", "drawn", "seconds")
        n = {name: sum(step[name] for step in steps) for name in names}
        outcomes: Counter[str] = Counter()
        for step in steps:
            outcomes.update(step["outcomes"])
        depth, total = [x for step in steps for x in step["depth"]], total + n["seconds"]
        mean, squares = (
            np.sum([step[name] for step in steps if step[name]], 0) / max(n["held"], 1) for name in ("sum", "squares")
        )
        objects.append(
            {
                "begun": begun,
                **{name: n[name] for name in ("attempts", "simulated", "strict", "held")},
                "success": _percent(n["held"], begun),
                "success_of_attempts": _percent(n["held"], n["attempts"]),
                "success_of_simulated": _percent(n["held"], n["simulated"]),
                "consumed": _percent(n["consumed"], n["held"]),
                "penetration_mean": float(np.mean(depth)) if depth else None,
                "penetration_median": float(np.median(depth)) if depth else None,
                "penetration_max": max(depth) if depth else None,
                "seconds": n["seconds"],
                "seconds_per_256": over(256 * n["seconds"], n["attempts"]),
                "held_per_s": over(n["held"], total),
                "strict_per_s": over(n["strict"], total),
                "diversity": float(np.sqrt(np.maximum(squares - mean**2, 0)).mean()) if n["held"] > 1 else None,
                "drawn_per_attempt": over(n["drawn"], n["attempts"]),
                "passed": _percent(outcomes["kept"], n["drawn"]),
                "outcomes": dict(outcomes),
            }
        )
    return {"begun": parts[0]["begun"], "spaces": spaces, "objects": objects}


def read_parts(path: Path) -> dict[str, Any]:
    """What an earlier run left in a file.

    Raises:
        ConfigError: the file is of no such run.
    """
    if not path.exists():
        return {}
    try:
        parts = json.loads(path.read_text(encoding="utf-8"))["parts"]
        for part in parts.values():
            summary([part])
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        raise ConfigError(
            f"--resume: {path} is of no run of lgrasp bench sequence; remove it or name another"
        ) from None
    return parts


def _as_published(pipeline: Pipeline) -> Pipeline:
    """The pipeline; for an optimiser, or draws that are not refined, with bounds as wide as the published ones."""
    params = pipeline.params("sequence")
    if params.method == "field" or (params.method == "diffuser" and params.refined):
        return pipeline
    return pipeline.with_bounds(
        max_penetration=0.01,
        min_object_distance=-0.01,
        min_self_distance=0.0,
        max_gap=0.05,
        max_normal_angle=180.0,
        max_normal_spread=180.0,
        max_gswo=10.0,
        max_unresisted_load=1.0,
    )


def _watched(simulate: Verdicts, seen: list[SequenceTable]) -> Verdicts:
    """The same simulation; the rows that it is given are kept."""

    def run(levels: list[SequenceTable]) -> dict[str, np.ndarray]:
        seen.append(levels[-1])
        return simulate(levels)

    return run


def _percent(part: int, whole: int) -> float | None:
    return over(100.0 * part, whole)


def sequence_page(result: dict[str, Any]) -> Page:
    """The tables as texts; published figures stand in parentheses beside what is counted as they are."""
    published, count = result["published"]["figures"], len(result["sequences"])
    head = [f"{result['device']}: {plural(count, 'sequence')} of objects; protocol {result['simulate']}"]
    tables = []
    for method, found in result["methods"].items():
        title = f"{method}: {found['begun']} attempts started with each sequence"
        tables += [_space_table(title, found["spaces"], published["spaces"])]
        tables += _object_tables(found["objects"], published | published.get(method.split()[0], {}))
    tables.append(_rate_table(result))
    notes = [
        "hold/begun: of all attempts begun; hold/tried: of all steps tried with a space; the others: of what was left",
        "drawn: candidates for each attempt at this step; pass: of these, through the filter",
        "(...): published; strict: rows within the bounds of the pipeline, whether they hold or not",
        *caveats(result["published"]),
    ]
    return Page(head, tables, notes)


def _space_table(title: str, spaces: dict[str, dict[str, int]], published: dict[str, float]) -> Table:
    rows: list[tuple[str, ...]] = [
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
    shares: list[tuple[str, ...]] = [
        (
            str(n + 1),
            *(number(entry[key]) for key in ("begun", "attempts", "simulated", "strict", "held")),
            _beside(entry["success"], published["success"], n, *_SHARE),
            *(number(entry[key], *_SHARE) for key in ("success_of_attempts", "success_of_simulated")),
        )
        for n, entry in enumerate(entries)
    ]
    measures: list[tuple[str, ...]] = [
        (
            str(n + 1),
            _beside(entry["penetration_mean"], published["penetration"], n, ".2f"),
            *(number(entry[key], ".2f") for key in ("penetration_median", "penetration_max")),
            _beside(entry["consumed"], published["consumed"], n, *_SHARE),
            _beside(entry["seconds_per_256"], published["seconds_per_256"], n, ".1f"),
            _beside(entry["diversity"], published["diversity"], n, ".3f"),
            number(entry["drawn_per_attempt"], ".0f"),
            number(entry["passed"], *_SHARE),
        )
        for n, entry in enumerate(entries)
    ]
    of = ("objects", "begun", "attempts", "simulated", "strict", "hold", "hold/begun", "hold/attempts", "hold/sim")
    by = ("objects", "penetration: mean mm", "median", "largest", "consumed", "s per 256 attempts", "diversity")
    return [Table("", of, shares), Table("", (*by, "drawn", "pass"), measures)]


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

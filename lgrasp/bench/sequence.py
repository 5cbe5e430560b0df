"""The published tables of sequential grasps, measured: success by opposition space and by number of objects."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.shard import add_counts
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.hand.opposition.spaces import consumed
from lgrasp.jobs.records import make_scene, mesh_blobs
from lgrasp.jobs.sequence.inputs import SequenceInputs, load_sequence_inputs, sequence_keys
from lgrasp.jobs.sequence.job import SequenceJob, simulated
from lgrasp.jobs.sequence.records import object_records
from lgrasp.jobs.sequence.round import Round, Verdicts, run_round
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels

PUBLISHED: dict[str, Any] = {
    "source": "Grasping a Handful (Lu et al., 2025), Tables II and III, Allegro hand, one NVIDIA A100",
    "spaces": {
        "middle-ring": 14.30,
        "index-middle": 13.90,
        "thumb-index": 5.75,
        "ring-palm": 45.57,
        "middle-palm": 37.74,
        "index-palm": 35.52,
        "thumb-palm": 17.67,
    },
    "consumed": [0.0, 3.88, 49.68, 100.0],
    "success": [50.04, 21.21, 19.49, 2.93],
    "penetration": [1.73, 2.14, 2.23, 2.70],
    "seconds_per_256": [900.0, 900.0, 900.0, 900.0],
    "diversity": [0.332, 0.367, 0.349, 0.312],
}
"""Success and consumed shares [%], mean largest penetration [mm], seconds for a batch of 256, diversity [rad]."""


def measure_sequences(
    jobs: list[SequenceJob], rounds: int, progress: Callable[[str], None] | None = None
) -> dict[str, Any]:
    """Run rounds of each job, simulate every row and go on from those that hold; nothing is written.

    Grasps of an optimiser are simulated as published: only a penetration of 1 cm, contacts farther away than that, and
    links in links are left out before.

    Args:
        jobs: the same method on several sequences of objects; each names a physics protocol.
        rounds: of each job.
        progress: called with one line before each round.

    Returns:
        ``spaces`` (name -> sequences tried with it, rows found, rows that held), ``objects`` (for each number of
        objects: rows simulated, strict-valid and held, consumed, ``seconds`` of the step, penetration of all rows [mm],
        diversity [rad]), ``strict_per_s`` (strict-valid rows of two objects, simulation not counted).
    """
    device = resolve_device(jobs[0].device)
    bounds = jobs[0].pipeline.bounds
    length = max(len(job.objects) for job in jobs)
    spaces: dict[str, dict[str, int]] = {}
    objects = [_Objects() for _ in range(length)]
    two, seconds = 0, 0.0
    for job in jobs:
        pipeline, cache = _as_published(job.pipeline), job.cache
        keys = sequence_keys(job.hand, job.objects, job.size, pipeline.seed, pipeline.object, pipeline.field)
        inputs = load_sequence_inputs(cache, keys, pipeline.object, pipeline.field, device)
        meshes = mesh_blobs(keys.source.urdf)
        scene = make_scene(cache, inputs.hand, object_records(inputs), meshes, device.alias)
        inputs = replace(inputs, scene=scene)
        load_kernels(device.alias, kernel_modules("lgrasp.stages."))
        assert job.physics
        simulate = simulated(inputs, job.physics)
        for number in range(rounds):
            if progress:
                names = " ".join(inputs.object_ids)
                progress(f"{pipeline.params('sequence').method}, {names}: round {number + 1} of {rounds}")
            seen: list[SequenceTable] = []
            workers = job.workers or os.cpu_count() or 1
            found = run_round(pipeline, inputs, 0, number, workers, verdicts=_watched(simulate, seen))
            _count_spaces(spaces, found)
            for step, table in enumerate(seen):
                strict = int(_strict(table, bounds).sum())
                objects[step].add(table, found.levels[step], inputs, found.walls[step], strict)
            two += int(_strict(seen[1], bounds).sum()) if len(seen) > 1 else 0
            seconds += sum(found.walls[:2])
    return {
        "spaces": spaces,
        "objects": [entry.summary() for entry in objects],
        "strict_per_s": two / seconds if seconds else 0.0,
    }


def _as_published(pipeline: Pipeline) -> Pipeline:
    """The pipeline; for an optimiser with the published bounds in place of those of strict validity."""
    if pipeline.params("sequence").method == "field":
        return pipeline
    return pipeline.with_bounds(
        max_penetration=0.01, min_self_distance=0.0, max_gap=0.01, max_normal_angle=60.0, max_gswo=1.0
    )


def _strict(table: SequenceTable, bounds: GraspBounds) -> np.ndarray:
    """Rows within the bounds in every step, (N,) bool."""
    m = table.metrics
    near = (m["gap"] <= bounds.max_gap) & (m["normal_error"] <= np.radians(bounds.max_normal_angle))
    return near & (m["penetration"] <= bounds.max_penetration) & (m["gswo"] <= bounds.max_gswo)


def _watched(simulate: Verdicts, seen: list[SequenceTable]) -> Verdicts:
    """The same simulation; the rows that it is given are kept."""

    def run(levels: list[SequenceTable]) -> dict[str, np.ndarray]:
        seen.append(levels[-1])
        return simulate(levels)

    return run


def _count_spaces(spaces: dict[str, dict[str, int]], found: Round) -> None:
    for step in found.spaces:
        for name, counts in step.items():
            grown, simulated_ = counts.get("sequence", {}), counts.get("validate", {})
            more = {
                "tried": grown.get("sequences", 0),
                "found": simulated_.get("tried", 0),
                "held": simulated_.get("held", 0),
            }
            add_counts(spaces, {name: more})


class _Objects:
    """Rows of one number of objects, over rounds and sequences."""

    def __init__(self) -> None:
        self._simulated = self._held = self._consumed = self._strict = 0
        self._seconds = 0.0
        self._depth: list[np.ndarray] = []
        self._q: list[np.ndarray] = []

    def add(
        self, tried: SequenceTable, held: SequenceTable, inputs: SequenceInputs, seconds: float, strict: int
    ) -> None:
        self._strict += strict
        self._simulated += len(tried)
        self._held += len(held)
        used = held.used
        self._consumed += sum(
            consumed(inputs.spaces, frozenset(s.tolist()), u) for s, u in zip(held.space, used, strict=True)
        )
        self._seconds += seconds
        self._depth.append(1e3 * tried.metrics["penetration"])
        self._q.append(held.q[:, -1])

    def summary(self) -> dict[str, Any]:
        depth = np.concatenate(self._depth) if self._depth else np.zeros(0)
        q = np.concatenate(self._q) if self._q else np.zeros((0, 1))
        return {
            "simulated": self._simulated,
            "strict": self._strict,
            "held": self._held,
            "success": _percent(self._held, self._simulated),
            "consumed": _percent(self._consumed, self._held),
            "penetration_median": float(np.median(depth)) if len(depth) else None,
            "penetration_max": float(depth.max()) if len(depth) else None,
            "seconds": self._seconds,
            "seconds_per_256": 256 * self._seconds / self._simulated if self._simulated else None,
            "diversity": float(q.std(0).mean()) if len(q) > 1 else None,
        }


def _percent(part: int, whole: int) -> float | None:
    return 100.0 * part / whole if whole else None

"""The job: hand + objects in an order -> shards of sequences in a folder."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import Found
from lgrasp.errors import LgraspError, StarvedError
from lgrasp.geometry.mesh_files import mesh_bytes, mesh_digest
from lgrasp.grasp.records import ObjectRecord
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.hand.model import HandModel
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.jobs.requests.search import SequenceRequest, sequence_name
from lgrasp.jobs.search import SearchJob
from lgrasp.jobs.sequence.inputs import SequenceInputs, SequenceKeys, load_sequence_inputs, sequence_keys
from lgrasp.jobs.sequence.records import object_records, sequence_rows
from lgrasp.jobs.sequence.round import Steps, Verdicts, add_steps
from lgrasp.jobs.sequence.shard import SequenceResult, make_sequences, most_rounds
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.cores import cores
from lgrasp.runtime.kept import Keeper
from lgrasp.sequence.size import parse_size
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import verdicts
from lgrasp.words import plural


class SequenceJob(SequenceRequest, SearchJob):
    """Sequences of grasps of several objects by one hand."""

    command: ClassVar[str] = "sequence"

    @property
    def object_name(self) -> str:
        return sequence_name(self.names)

    @property
    def protocol(self) -> str | None:
        return self.simulate

    @cached_property
    def keys(self) -> SequenceKeys:
        """Content keys of hand, views, fields and objects."""
        pipeline, size = self.pipeline, parse_size(self.scale)
        return sequence_keys(self.hand, self.objects, size, pipeline.seed, pipeline.object, pipeline.field)

    @property
    def object_hashes(self) -> set[str] | None:
        return {mesh_digest(mesh_bytes(path)) for path in self.keys.meshes}

    def own_config(self) -> dict[str, Any]:
        return {"objects": list(self.names), "scales": list(self.keys.scales), "physics": self.simulate}

    def key(self) -> str:
        return self.keys.run_key(self.pipeline.describe(), self.shard_rows, self.simulate)

    def gave_up(self, rows: int, found: Found) -> bool:
        return found.tried >= most_rounds(self.pipeline, rows)

    def load_inputs(self, events: Events) -> SequenceInputs:
        what = self.keys, self.pipeline.object, self.pipeline.field, self.device_used, events.loading
        return self.with_sampler(load_sequence_inputs(self.cache, *what, self.clouds_by_key()))

    def clouds_by_key(self) -> dict[str, Callable[[], ObjectModel]]:
        """What makes the objects that are point clouds."""
        return {}

    def with_sampler(self, inputs: SequenceInputs) -> SequenceInputs:
        """Inputs with what method diffuser needs."""
        return inputs

    def records(self, inputs: SequenceInputs) -> tuple[HandModel, list[ObjectRecord]]:
        return inputs.hand, object_records(inputs)

    def make(self, part: Part, progress: PartProgress) -> Made:
        result = make_sequences(
            self.pipeline,
            self.inputs,
            part.number,
            part.rows,
            self.threads(),
            progress=lambda rows, ahead: progress(rows, ahead=ahead),
            verdicts=simulated(self.inputs, self.simulate) if self.simulate else None,
        )
        forgotten = replace(result, levels=[])
        if not len(result):
            return Made(0, None, forgotten)
        statistics = {
            "sequences": len(result),
            "rounds": result.rounds,
            **{f"found_{step}": found for step, found in enumerate(result.reached, 1)},
        }
        rows = sequence_rows(result.levels, self.inputs, part.number, self.protocol_text())
        return Made(len(result), self.shard(part, result, rows, statistics), forgotten)

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """The results in numbers.

        Returns:
            ``sequences`` (whole ones on disk), ``reached`` (rows found by number of objects), ``steps`` (survivors by
            step and stage), ``spaces`` (sequences by step and space), ``penetration`` (median and largest [mm], all
            rows), ``seconds`` (``wall`` of the sequences, thread-seconds per stage, loading, total), ``per_s`` and what
            was asked.
        """
        inputs, params, sums = self.inputs, self.pipeline.params("sequence"), self.sums(outcome)
        depth, made = [], {part.file for part, _ in outcome.made_parts}
        reached = np.zeros(len(inputs.objects), int)
        for result in outcome.results:
            reached[: len(result.reached)] += result.reached
        for path in outcome.paths:
            with ShardReader(path) as reader:
                depth.append(reader.column("metrics/penetration"))
                if path not in made:
                    reached += [int(reader.statistics.get(f"found_{n}", 0)) for n in range(1, len(reached) + 1)]
        depth = np.concatenate(depth or [np.zeros(1)])
        wall = sums["seconds"]["wall"]
        return {
            "sequences": outcome.rows,
            "reached": reached.tolist(),
            **{name: _steps(inputs, outcome.results, name) for name in ("steps", "spaces")},
            "penetration": [1e3 * float(np.median(depth)), 1e3 * float(depth.max())],
            "per_s": outcome.made / wall if wall else 0.0,
            "objects": list(inputs.object_ids),
            "scales": list(inputs.keys.scales),
            "method": params.method,
            "policy": params.policy,
            "simulate": self.simulate,
            **sums,
        }

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        if not outcome.starved:
            return None
        if not outcome.rows:
            return StarvedError(_unheld(self.inputs, outcome.results))
        reached = ", ".join(f"{count:,} of {n}" for n, count in enumerate(self.report(outcome)["reached"], 1))
        asked = sum(part.rows for part in outcome.parts)
        return StarvedError(
            f"{outcome.rows:,} of {asked:,} sequences found; rows reached, by number of objects: {reached}"
        )


def simulated(inputs: SequenceInputs, name: str) -> Verdicts:
    """A function that simulates the rows of the last of some levels, on all cores."""
    protocol, scene = find_protocol(name), inputs.scene
    assert scene is not None
    kept = Keeper()

    def run(levels: list[SequenceTable]) -> dict[str, np.ndarray]:
        last = replace(levels[-1], physics={})
        rows = sequence_rows([last], inputs, 0, objects=len(inputs.objects))
        return verdicts(scene, rows, protocol, threads=cores(), device=inputs.device.alias, keep=kept.get)

    return run


def _unheld(inputs: SequenceInputs, results: Sequence[SequenceResult]) -> str:
    """Which object no opposition space could hold, and why: one line."""
    reached = next((r.reached for r in results), [])
    step = next((s for s, found in enumerate(reached) if found == 0), len(reached))
    step = min(step, len(inputs.objects) - 1)
    model, path = inputs.objects[step].model, inputs.keys.meshes[step]
    sides = " x ".join(f"{1e3 * side:.0f}" for side in model.extents)
    counts, spaces = (_steps(inputs, results, name)[step] for name in ("steps", "spaces"))
    stage, words = starving_stage(counts)
    why = f"stage {stage}, {words}; tried: {', '.join(spaces)}"
    return (
        f"object {step + 1} ({path}, {sides} mm) is held by no opposition space of hand '{inputs.hand.name}'"
        + (f" after {plural(step, 'other object')}" if step else "")
        + f": {why if spaces else 'none was left'}; --scale changes its size"
    )


def _steps(inputs: SequenceInputs, results: Sequence[SequenceResult], name: str) -> Steps:
    """Counts of all shards made, ``steps`` or ``spaces`` of their results."""
    total: Steps = [{} for _ in inputs.objects]
    for result in results:
        add_steps(total, getattr(result, name))
    return total

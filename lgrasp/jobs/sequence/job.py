"""The job: hand + objects in an order -> shards of sequences in a folder."""

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field, PrivateAttr

from lgrasp.config import HandName, ShardFolder
from lgrasp.dataset import Shard, ShardHeader
from lgrasp.dataset.info import survivors
from lgrasp.engine.events import Events, Made, Part, PartProgress
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.run import Job, JobOutcome
from lgrasp.engine.shard import flat_statistics
from lgrasp.errors import ConfigError, LgraspError, ObjectError, StarvedError
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.jobs.generate import check_size, shard_parts
from lgrasp.jobs.records import hand_config, hand_record, make_scene, mesh_blobs
from lgrasp.jobs.sequence.inputs import SequenceInputs, SequenceKeys, load_sequence_inputs, sequence_keys
from lgrasp.jobs.sequence.records import object_records, sequence_rows
from lgrasp.jobs.sequence.report import sequence_report, unheld
from lgrasp.jobs.sequence.round import Verdicts
from lgrasp.jobs.sequence.shard import SequenceResult, make_sequences, most_rounds
from lgrasp.jobs.sequence.size import parse_size
from lgrasp.jobs.sets import sequence_name
from lgrasp.runtime.device import resolve_device
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import check_installed, protocol_text, verdicts
from lgrasp.stages.context import Keeper


class SequenceJob(Job):
    """Sequences of grasps of several objects by one hand."""

    RENAMED: ClassVar[dict[str, str]] = {"physics": "simulate"}

    unit: ClassVar[str] = "sequences"
    asks: ClassVar[bool] = True

    hand: HandName = "allegro"
    objects: tuple[str, ...] = Field(description="Names or mesh files, in the order in which they are grasped.")
    rows: int = Field(default=256, description="Complete sequences requested.")
    pipeline: Pipeline
    out: ShardFolder
    scale: str = Field(default="1", description="Factor to metres, or range of the longest side [m] such as 0.06:0.10.")
    simulate: str | None = Field(
        default=None, description="Protocol that the rows of every step must pass to be continued."
    )
    shard_rows: int = Field(default=1000, description="Sequences of a shard; part of what decides the rows.")
    _keys: SequenceKeys | None = PrivateAttr(None)
    _inputs: SequenceInputs | None = PrivateAttr(None)
    _meshes: dict[str, bytes] = PrivateAttr(default_factory=dict)

    @property
    def title(self) -> str:
        return " ".join(Path(name).stem for name in (self.hand, *self.objects))

    @property
    def folder(self) -> Path:
        return self.out

    @property
    def keys(self) -> SequenceKeys:
        """Content keys of hand, views, fields and objects."""
        if self._keys is None:
            pipeline = self.pipeline
            self._keys = sequence_keys(
                self.hand, self.objects, parse_size(self.scale), pipeline.seed, pipeline.object, pipeline.field
            )
        return self._keys

    @property
    def inputs(self) -> SequenceInputs:
        """The inputs of the sequences, once loaded."""
        assert self._inputs is not None
        return self._inputs

    def key(self) -> str:
        return self.keys.run_key(self.pipeline.describe(), self.shard_rows, self.simulate)

    def parts(self) -> list[Part]:
        check_size(self.rows, self.shard_rows, self.workers)
        if self.pipeline.sequence is None:
            raise ConfigError(
                f"pipeline '{self.pipeline.name}' has no sequence; use pipeline sequence, or add 'sequence: {{}}' to it"
            )
        if self.simulate:
            find_protocol(self.simulate)
            check_installed(resolve_device(self.device).alias)
        name = sequence_name("", self.objects)[1:]
        return shard_parts(self.out, self.keys.source.name, name, self.rows, self.shard_rows)

    def effort(self, rows: int) -> int:
        return most_rounds(self.pipeline, rows)

    def load(self, events: Events, missing: bool) -> None:
        pipeline, device = self.pipeline, self.device_used
        inputs = load_sequence_inputs(self.cache, self.keys, pipeline.object, pipeline.field, device, events.loading)
        self._meshes = mesh_blobs(self.keys.source.urdf)
        if missing and self.simulate:
            events.loading("scene")
            scene = make_scene(self.cache, inputs.hand, object_records(inputs), self._meshes, device.alias)
            inputs = replace(inputs, scene=scene)
        self._inputs = inputs

    def make(self, part: Part, progress: PartProgress) -> Made:
        start = time.monotonic()

        def tell(rows: int, result: SequenceResult) -> None:
            flow = "  ".join(f"{stage} {count:,}" for stage, count in survivors(result.counts).items())
            progress(rows, f"{rows / max(time.monotonic() - start, 1e-9):,.0f}/s  {flow}")

        result = make_sequences(
            self.pipeline,
            self.inputs,
            part.number,
            part.rows,
            self.threads(),
            check=progress.check,
            progress=tell,
            verdicts=simulated(self.inputs, self.simulate) if self.simulate else None,
        )
        contents = self._shard(part, result) if len(result) else None
        return Made(len(result), contents, replace(result, levels=[]))

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        return sequence_report(self, outcome)

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        if not outcome.starved:
            return None
        if not outcome.rows:
            return ObjectError(unheld(self.inputs, outcome.results))
        reached = ", ".join(f"{count:,} of {n}" for n, count in enumerate(self.report(outcome)["reached"], 1))
        asked = sum(part.rows for part in outcome.parts)
        return StarvedError(
            f"{outcome.rows:,} of {asked:,} sequences found; rows reached, by number of objects: {reached}"
        )

    def _shard(self, part: Part, result: SequenceResult) -> Shard:
        inputs, protocol_name = self.inputs, self.simulate
        header = ShardHeader(
            pipeline=self.pipeline.name,
            seed=self.pipeline.seed,
            shard_index=part.number,
            config={
                "run_key": self.key(),
                "pipeline": self.pipeline.describe(),
                "bounds": self.pipeline.bounds.describe(),
                "objects": list(self.objects),
                "scales": list(self.keys.scales),
                "shard_rows": self.shard_rows,
                "physics": protocol_name,
                **hand_config(self.keys.source),
            },
        )
        statistics = {
            "device": inputs.device.name,
            "sequences": len(result),
            "rounds": result.rounds,
            "duplicates_dropped": result.duplicates,
            "exhausted": int(result.exhausted),
            "seconds_wall": result.wall,
            **{f"found_{step}": found for step, found in enumerate(result.reached, 1)},
        }
        protocol = ""
        if protocol_name and inputs.scene:
            protocol = protocol_text(inputs.scene, find_protocol(protocol_name), device=inputs.device.alias)
        return Shard(
            header=header,
            hand=hand_record(inputs.hand, self._meshes),
            objects=object_records(inputs),
            grasps=sequence_rows(result.levels, inputs, part.number, protocol),
            statistics=statistics | flat_statistics(result.counts, result.seconds),
        )


def simulated(inputs: SequenceInputs, name: str) -> Verdicts:
    """A function that simulates the rows of the last of some levels, on all cores."""
    protocol, scene = find_protocol(name), inputs.scene
    assert scene is not None
    kept = Keeper()

    def run(levels: list[SequenceTable]) -> dict[str, np.ndarray]:
        last = replace(levels[-1], physics={})
        rows = sequence_rows([last], inputs, 0, objects=len(inputs.objects))
        return verdicts(scene, rows, protocol, threads=os.cpu_count() or 1, device=inputs.device.alias, keep=kept.get)

    return run

"""The main job: hand + object -> grasp shards in a folder."""

import math
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
from lgrasp.engine.folder import shard_path
from lgrasp.engine.graphs import GraphCache
from lgrasp.engine.inputs import InputKeys, Inputs, input_keys, load_inputs, run_key
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.run import Job, JobOutcome, run
from lgrasp.engine.shard import Execution, ShardResult, flat_statistics, make_shard, shard_effort
from lgrasp.errors import ConfigError, LgraspError, StarvedError
from lgrasp.grasp.rows import grasp_rows
from lgrasp.grasp.tables import take_grasps
from lgrasp.jobs.bottleneck import starving_stage
from lgrasp.jobs.generated import generated_report
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.records import hand_config, hand_record, make_scene, mesh_blobs, object_record
from lgrasp.runtime.device import resolve_device


class GenerateJob(Job):
    """Grasps of one object by one hand."""

    asks: ClassVar[bool] = True

    hand: HandName = "allegro"
    object: str = Field(description="Name or mesh file.")
    rows: int = Field(default=1000, description="Grasps requested.")
    pipeline: Pipeline
    out: ShardFolder
    scale: float = Field(default=1.0, gt=0, description="Factor from the mesh's unit to metres.")
    batch: int = Field(default=0, description="Candidates per batch; 0: by device.")
    rate: float = Field(default=1.0, description="Rows expected per candidate by the first shard; never changes rows.")
    shard_rows: int = Field(default=10_000, description="Rows of a shard; part of what decides the rows.")
    reuse: bool = Field(default=False, description="Cache the state of shards; later runs continue from there.")
    _keys: InputKeys | None = PrivateAttr(None)
    _inputs: Inputs | None = PrivateAttr(None)
    _meshes: dict[str, bytes] = PrivateAttr(default_factory=dict)
    _graphs: GraphCache | None = PrivateAttr(None)
    _rate: float = PrivateAttr(1.0)

    @property
    def title(self) -> str:
        return f"{Path(self.hand).stem} {Path(self.object).stem} {self.pipeline.name}"

    @property
    def folder(self) -> Path:
        return self.out

    @property
    def keys(self) -> InputKeys:
        """Content keys of hand, object and field."""
        if self._keys is None:
            source, pipeline = hand_source(self.hand), self.pipeline
            self._keys = input_keys(source, self.object, self.scale, pipeline.object, pipeline.field)
        return self._keys

    @property
    def inputs(self) -> Inputs:
        """Hand, object and field, once they are loaded."""
        assert self._inputs is not None
        return self._inputs

    @property
    def measured_rate(self) -> float:
        """Rows per candidate of the last shard made; ``rate`` if none was."""
        return self._rate if self._inputs else self.rate

    def key(self) -> str:
        return run_key(self.pipeline.describe(), self.keys, self.shard_rows)

    def parts(self) -> list[Part]:
        check_size(self.rows, self.shard_rows, self.workers)
        if self.batch < 0:
            raise ConfigError(f"--batch {self.batch}: must be at least 0 (0: by device)")
        if not 0 < self.rate < math.inf:
            raise ConfigError(f"rate {self.rate}: the rows expected per candidate must be positive and finite")
        if self.pipeline.sequence is not None:
            raise ConfigError(
                f"pipeline '{self.pipeline.name}' is for several objects: lgrasp sequence OBJECT OBJECT ..."
            )
        if "simulate" in self.pipeline.order:
            from lgrasp.simulate.run import check_installed

            check_installed(resolve_device(self.device).alias)
        assert self.keys.mesh is not None
        return shard_parts(self.out, self.keys.source.name, self.keys.mesh.stem, self.rows, self.shard_rows)

    def effort(self, rows: int) -> int:
        return shard_effort(self.pipeline, rows)

    def load(self, events: Events, missing: bool) -> None:
        pipeline, device = self.pipeline, self.device_used
        inputs = load_inputs(self.cache, self.keys, self.scale, pipeline.object, pipeline.field, device, events.loading)
        self._meshes = mesh_blobs(self.keys.source.urdf)
        if missing and "simulate" in pipeline.order:
            events.loading("scene")
            objects = [object_record(inputs.object.model)]
            scene = make_scene(self.cache, inputs.hand.model, objects, self._meshes, device.alias)
            inputs = replace(inputs, scene=scene)
        self._graphs = GraphCache(pipeline) if device.is_cuda and self.threads() == 1 else None
        self._inputs, self._rate = inputs, self.rate

    def make(self, part: Part, progress: PartProgress) -> Made:
        start = time.monotonic()

        def tell(rows: int, result: ShardResult) -> None:
            flow = "  ".join(f"{stage} {count:,}" for stage, count in survivors(result.counts).items())
            progress(rows, f"{rows / max(time.monotonic() - start, 1e-9):,.0f}/s  {flow}")

        result = make_shard(
            self.pipeline,
            self.inputs,
            part.number,
            part.rows,
            Execution(self.threads(), self.batch, self._rate, self._graphs),
            bank_cache=self.cache if self.reuse else None,
            progress=tell,
        )
        kept = result.counts.get("simulate", {}).get("held", result.counts.get("filter", {}).get("kept", 0))
        self._rate = max(kept / result.candidates, 1e-3)
        contents = self._shard(part, result)
        found = len(result.grasps)
        # a copy: memory must not grow with the shards
        return Made(found, contents, replace(result, grasps=take_grasps(result.grasps, np.zeros(0, int))))

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        return generated_report(self, outcome)

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        if not outcome.starved:
            return None
        stage, words = starving_stage(self.report(outcome)["counts"])
        return StarvedError(f"{outcome.rows:,} of {self.rows:,} grasps found; stage {stage} is the bottleneck: {words}")

    def _shard(self, part: Part, result: ShardResult) -> Shard:
        """The shard as records; poses and contacts go from the internal to the user's frame of the object."""
        inputs, model = self.inputs, self.inputs.hand.model
        header = ShardHeader(
            pipeline=self.pipeline.name,
            seed=self.pipeline.seed,
            shard_index=part.number,
            config={
                "run_key": self.key(),
                "pipeline": self.pipeline.describe(),
                "bounds": self.pipeline.bounds.describe(),
                "object": self.object,
                "scale": self.scale,
                "shard_rows": self.shard_rows,
                "reuse": self.reuse,
                **hand_config(self.keys.source),
            },
        )
        statistics = {
            "device": inputs.device.name,
            "candidates": result.candidates,
            "duplicates_dropped": result.duplicates,
            "exhausted": int(result.exhausted),
            "seconds_wall": result.wall,
        }
        return Shard(
            header=header,
            hand=hand_record(model, self._meshes),
            objects=[object_record(inputs.object.model)],
            grasps=grasp_rows(
                result.grasps, model.tree, inputs.object.model.center, shard=part.number, protocol=self._protocol()
            ),
            statistics=statistics | flat_statistics(result.counts, result.seconds),
        )

    def _protocol(self) -> str:
        """What was simulated, "" if nothing was."""
        if self.inputs.scene is None:
            return ""
        from lgrasp.simulate.protocol import find_protocol
        from lgrasp.simulate.run import protocol_text

        protocol = find_protocol(self.pipeline.params("simulate").protocol)
        return protocol_text(self.inputs.scene, protocol, device=self.device_used.alias)


def check_size(rows: int, shard_rows: int, workers: int) -> None:
    """Raises ConfigError for numbers out of range."""
    if rows <= 0:
        raise ConfigError(f"-n {rows}: request at least 1")
    if shard_rows <= 0:
        raise ConfigError(f"--shard-rows {shard_rows}: must be at least 1")
    if workers < 0:
        raise ConfigError(f"--workers {workers}: must be at least 0 (0: by device)")


def shard_parts(out: Path, hand: str, name: str, rows: int, shard_rows: int) -> list[Part]:
    """Shards of ``shard_rows`` rows, the last perhaps of fewer."""
    total = -(-rows // shard_rows)
    return [Part(s, shard_path(out, hand, name, s), min(shard_rows, rows - s * shard_rows)) for s in range(total)]


def generate(
    job: GenerateJob, events: Events | None = None, *, array: tuple[int, int] = (0, 1), resume: bool = True
) -> JobOutcome:
    """Make the missing shards of a job; see :func:`lgrasp.engine.run.run`."""
    return run(job, events, array=array, resume=resume)

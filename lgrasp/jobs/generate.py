"""The main job: hand + object -> grasp shards in a folder."""

import math
import os
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset import GraspRows, Shard, ShardHeader
from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder, clean_folder, present_shards, shard_path
from lgrasp.engine.graphs import Recorder
from lgrasp.engine.inputs import Inputs, input_keys, load_inputs, run_key
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.shard import Execution, Found, ShardResult, flat_statistics, make_shard, shard_effort, split_rows
from lgrasp.engine.writing import BackgroundWriter
from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import GraspTable, take_grasps, user_poses
from lgrasp.jobs.hands import hand_source
from lgrasp.jobs.records import hand_config, hand_record, make_scene, mesh_blobs, object_record
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels

METRIC_UNITS = {"penetration": "m", "self_penetration": "m", "gap": "m", "normal_error": "rad"}


@dataclass(frozen=True)
class Job:
    """On what and where."""

    hand: str
    object: str
    rows: int
    pipeline: Pipeline
    out: Path
    scale: float = 1.0
    device: str = "auto"
    workers: int = 0  # 0: all cores (1 on a GPU)
    batch: int = 0
    rate: float = 1.0  # rows expected per candidate by the first shard; sizes its batches on a GPU, never changes rows
    shard_rows: int = 10_000
    shard_index: int = 0
    num_shards: int = 1
    reuse: bool = False
    resume: bool = True
    cache: Cache = field(default_factory=Cache)


class Listener:
    """What a job tells while it runs; every method may be overridden."""

    def loading(self, what: str, share: float) -> None:
        """An input is being loaded or made."""

    def started(self, inputs: Any, shards: list[int], present: list[int]) -> None:
        """Inputs are ready; ``present`` of ``shards`` are on disk already."""

    def advanced(self, shard: int, rows: int, result: Found) -> None:
        """A batch of a shard is done; ``rows`` of it are found so far."""

    def wrote(self, shard: int, path: Path, result: Found) -> None:
        """A shard is on disk."""

    def cancelled(self) -> bool:
        """Should the job stop after the running batch?"""
        return False


@dataclass
class Outcome:
    """What a job did."""

    inputs: Inputs
    paths: list[Path]
    rows: int  # rows on disk of this job's shards
    made: int  # rows made by this call
    present: int  # rows found on disk
    results: list[ShardResult]  # without their grasps, which are in the shards
    wall: float  # whole call [s]
    starved: bool
    cancelled: bool = False
    written: list[Path] = field(default_factory=list)  # shards made by this call
    rate: float = 1.0  # rows per candidate of the last shard made; Job.rate if none was


def job_shards(job: Job) -> list[tuple[int, int]]:
    """(shard, rows) of every shard that this job (array task) makes.

    Raises:
        ConfigError: n, shard rows, workers, batch, rate or array numbers out of range.
    """
    if job.rows <= 0:
        raise ConfigError(f"-n {job.rows}: the number of grasps must be at least 1")
    if job.shard_rows <= 0:
        raise ConfigError(f"--shard-rows {job.shard_rows}: must be at least 1")
    if job.workers < 0 or job.batch < 0:
        raise ConfigError(f"--workers {job.workers} --batch {job.batch}: must be at least 0 (0: by device)")
    if not 0 < job.rate < math.inf:
        raise ConfigError(f"rate {job.rate}: the rows expected per candidate must be positive and finite")
    if "sequence" in job.pipeline.order:
        raise ConfigError(f"pipeline '{job.pipeline.name}' is for several objects: lgrasp sequence OBJECT OBJECT ...")
    return split_rows(job.rows, job.shard_rows, job.shard_index, job.num_shards)


def find_present(job: Job, files: dict[int, Path], key: str) -> dict[int, int]:
    """Shards of a job that need not be made, with their numbers of rows.

    Raises:
        OutputError: see :func:`present_shards`.
    """
    if not job.resume:
        return {}
    return present_shards(files, dict(job_shards(job)), key, partial(shard_effort, job.pipeline), job.cache.warn)


def generate(job: Job, listener: Listener | None = None) -> Outcome:
    """Make the missing shards of a job.

    Raises:
        LgraspError: bad input, unwritable output, or files of another run in the output folder.
    """
    listener = listener or Listener()
    start = time.perf_counter()
    shards = job_shards(job)
    device = resolve_device(job.device)
    pipeline = job.pipeline
    if "validate" in pipeline.order:
        from lgrasp.simulate.model import import_mujoco

        import_mujoco()
    keys = input_keys(hand_source(job.hand), job.object, job.scale, pipeline.object, pipeline.field)
    assert keys.mesh is not None
    check_folder(job.out)
    key = run_key(pipeline.describe(), keys, job.shard_rows)
    files = {s: shard_path(job.out, keys.source.name, keys.mesh.stem, s) for s, _ in shards}
    for path in list(files.values())[:1]:
        clean_folder(path)
    present = find_present(job, files, key)
    inputs = load_inputs(job.cache, keys, job.scale, pipeline.object, pipeline.field, device, listener.loading)
    meshes = mesh_blobs(keys.source.urdf)
    if len(present) < len(shards):
        if "validate" in pipeline.order:
            listener.loading("scene", 0.0)
            objects = [object_record(inputs.object.model)]
            inputs = replace(inputs, scene=make_scene(job.cache, inputs.hand.model, objects, meshes, device.alias))
        begin = time.perf_counter()
        load_kernels(device.alias, kernel_modules("lgrasp.stages."), listener.loading)
        inputs.seconds["kernels"] = time.perf_counter() - begin
    workers = job.workers or (1 if device.is_cuda else os.cpu_count() or 1)
    replayed = device.is_cuda and workers == 1 and not job.reuse and pipeline.params("search").passes == 1
    recorder = Recorder(pipeline) if replayed else None
    execution = Execution(workers, job.batch, listener.cancelled, job.rate, recorder)
    listener.started(inputs, [s for s, _ in shards], list(present))
    outcome = Outcome(inputs, [], sum(present.values()), 0, sum(present.values()), [], 0.0, False)
    wanted = dict(shards)

    def written(shard: int, result: ShardResult) -> None:
        found = len(result.grasps)
        outcome.written.append(files[shard])
        outcome.made += found
        outcome.rows += found
        outcome.starved |= found < wanted[shard]
        outcome.results.append(result)
        listener.wrote(shard, files[shard], result)
        result.grasps = take_grasps(result.grasps, np.zeros(0, int))  # a copy: memory must not grow with the shards

    with BackgroundWriter(written) as writer:
        for shard, rows in shards:
            if shard in present:
                outcome.starved |= present[shard] < rows
                found = present[shard]
            else:
                if listener.cancelled():
                    outcome.cancelled = True
                    break
                result = make_shard(
                    pipeline,
                    inputs,
                    shard,
                    rows,
                    execution,
                    bank_cache=job.cache if job.reuse else None,
                    progress=lambda found, running, shard=shard: listener.advanced(shard, found, running),
                )
                if result.cancelled:
                    outcome.cancelled = True
                    break
                found = len(result.grasps)
                kept = result.counts.get("validate", {}).get("held", result.counts.get("filter", {}).get("kept", 0))
                execution = replace(execution, rate=max(kept / result.candidates, 1e-3))
                writer.put(shard, files[shard], _shard(job, inputs, meshes, key, shard, result), result)
            if found == 0:  # nor will the next shards give any
                break
    outcome.rate = execution.rate
    outcome.paths = [files[s] for s, _ in shards if s in present or files[s] in outcome.written]
    outcome.wall = time.perf_counter() - start
    return outcome


def _shard(job: Job, inputs: Inputs, meshes: dict[str, bytes], key: str, shard: int, result: ShardResult) -> Shard:
    """The shard as records; poses and contacts go from the internal to the user's frame of the object."""
    return Shard(
        header=ShardHeader(
            pipeline=job.pipeline.name,
            seed=job.pipeline.seed,
            shard_index=shard,
            config={
                "run_key": key,
                "pipeline": job.pipeline.describe(),
                "bounds": job.pipeline.bounds.describe(),
                "object": job.object,
                "scale": job.scale,
                "shard_rows": job.shard_rows,
                "reuse": job.reuse,
                **hand_config(inputs.keys.source),
            },
        ),
        hand=hand_record(inputs.hand.model, meshes),
        objects=[object_record(inputs.object.model)],
        grasps=_rows(result.grasps, job.pipeline, inputs, shard),
        statistics=_statistics(inputs, result),
    )


def _statistics(inputs: Inputs, result: ShardResult) -> dict[str, Any]:
    flat: dict[str, Any] = {
        "device": inputs.device.name,
        "candidates": result.candidates,
        "duplicates_dropped": result.duplicates,
        "exhausted": int(result.exhausted),
        "seconds_wall": result.wall,
    }
    return flat | flat_statistics(result.counts, result.seconds)


def _rows(table: GraspTable, pipeline: Pipeline, inputs: Inputs, shard: int) -> GraspRows:
    tree, center = inputs.hand.model.tree, inputs.object.model.center
    filled = table.contact_links >= 0
    width = max(1, int(filled.sum(1).max(initial=1)))
    points = (table.contact_points + center)[:, :width]

    return GraspRows(
        q=tree.listed_values(table.q),
        q_pregrasp=tree.listed_values(table.q_pregrasp),
        q_squeeze=tree.listed_values(table.q_squeeze),
        object_pose=user_poses(table.pose, center)[:, None],
        object_index=np.zeros((len(table), 1), np.int32),
        contact_points=points[:, None],
        contact_normals=table.contact_normals[:, None, :width],
        contact_links=table.contact_links[:, None, :width].astype(np.int16),
        contact_forces=table.contact_forces[:, None, :width],
        candidate=(np.uint64(shard) << np.uint64(40)) + table.index.astype(np.uint64),
        metrics=dict(table.metrics) | {"contacts": filled.sum(1).astype(np.float32)},
        metric_units=METRIC_UNITS,
        physics=table.physics,
        physics_protocols=dict.fromkeys(table.physics, _protocol(pipeline, inputs)),
    )


def _protocol(pipeline: Pipeline, inputs: Inputs) -> str:
    """What was simulated, "" if nothing was."""
    if inputs.scene is None:
        return ""
    from lgrasp.simulate.protocol import find_protocol
    from lgrasp.simulate.run import protocol_text

    return protocol_text(inputs.scene, find_protocol(pipeline.params("validate").protocol))

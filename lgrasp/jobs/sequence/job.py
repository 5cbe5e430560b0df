"""The job: hand + objects in an order -> shards of sequences in a folder."""

import os
import time
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset import Shard, ShardHeader
from lgrasp.engine.cache import Cache
from lgrasp.engine.folder import check_folder, clean_folder, present_shards, shard_path
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.shard import flat_statistics, split_rows
from lgrasp.engine.writing import BackgroundWriter
from lgrasp.errors import ConfigError
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.jobs.generate import Listener
from lgrasp.jobs.records import hand_config, hand_record, make_scene, mesh_blobs
from lgrasp.jobs.sequence.inputs import SequenceInputs, SequenceKeys, load_sequence_inputs, sequence_keys
from lgrasp.jobs.sequence.records import object_records, sequence_rows
from lgrasp.jobs.sequence.round import Verdicts
from lgrasp.jobs.sequence.shard import SequenceResult, make_sequences, most_rounds
from lgrasp.jobs.sequence.size import Size
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels
from lgrasp.simulate.model import import_mujoco
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import protocol_text, verdicts


@dataclass(frozen=True)
class SequenceJob:
    """On what and where."""

    hand: str
    objects: tuple[str, ...]  # in the order in which they are grasped
    rows: int  # whole sequences
    pipeline: Pipeline
    out: Path
    size: Size = field(default_factory=Size)
    physics: str | None = None  # protocol that the rows of every step must pass before they go on
    device: str = "auto"
    workers: int = 0  # 0: all cores (1 on a GPU)
    shard_rows: int = 1000
    shard_index: int = 0
    num_shards: int = 1
    resume: bool = True
    cache: Cache = field(default_factory=Cache)


@dataclass
class SequenceOutcome:
    """What a job did."""

    inputs: SequenceInputs
    paths: list[Path]
    rows: int  # whole sequences on disk of this job's shards
    made: int  # whole sequences made by this call
    present: int
    results: list[SequenceResult]  # without their rows, which are in the shards
    wall: float
    starved: bool
    cancelled: bool = False
    written: list[Path] = field(default_factory=list)


def sequence_name(hand: str, objects: tuple[str, ...]) -> str:
    """HAND-OBJECT-OBJECT..., for files and folders."""
    return "-".join([hand, *(Path(name).stem for name in objects)])


def sequence_shards(job: SequenceJob) -> list[tuple[int, int]]:
    """(shard, whole sequences) of every shard that this job (array task) makes.

    Raises:
        ConfigError: n, shard rows, workers or array numbers out of range, or a pipeline without stage sequence.
    """
    if job.rows <= 0 or job.shard_rows <= 0:
        raise ConfigError(f"-n {job.rows} --shard-rows {job.shard_rows}: both must be at least 1")
    if job.workers < 0:
        raise ConfigError(f"--workers {job.workers}: must be at least 0 (0: by device)")
    if "sequence" not in job.pipeline.order:
        raise ConfigError(f"pipeline '{job.pipeline.name}' has no stage sequence; use pipeline sequence, or add it")
    return split_rows(job.rows, job.shard_rows, job.shard_index, job.num_shards)


def generate_sequences(job: SequenceJob, listener: Listener | None = None) -> SequenceOutcome:
    """Make the missing shards of a job.

    Raises:
        LgraspError: bad input, unwritable output, or files of another run in the output folder.
    """
    listener = listener or Listener()
    start = time.perf_counter()
    shards = sequence_shards(job)
    device, pipeline = resolve_device(job.device), job.pipeline
    if job.physics:
        find_protocol(job.physics)
        import_mujoco()
    keys = sequence_keys(job.hand, job.objects, job.size, pipeline.seed, pipeline.object, pipeline.field)
    check_folder(job.out)
    key = keys.run_key(pipeline.describe(), job.shard_rows, job.physics)
    name = sequence_name("", job.objects)[1:]
    files = {s: shard_path(job.out, keys.source.name, name, s) for s, _ in shards}
    for path in list(files.values())[:1]:
        clean_folder(path)
    wanted = dict(shards)
    present = {}
    if job.resume:
        present = present_shards(files, wanted, key, partial(most_rounds, pipeline), job.cache.warn)
    inputs = load_sequence_inputs(job.cache, keys, pipeline.object, pipeline.field, device, listener.loading)
    meshes = mesh_blobs(keys.source.urdf)
    if len(present) < len(shards):
        if job.physics:
            listener.loading("scene", 0.0)
            scene = make_scene(job.cache, inputs.hand, object_records(inputs), meshes, device.alias)
            inputs = replace(inputs, scene=scene)
        begin = time.perf_counter()
        load_kernels(device.alias, kernel_modules("lgrasp.stages."), listener.loading)
        inputs.seconds["kernels"] = time.perf_counter() - begin
    workers = job.workers or (1 if device.is_cuda else os.cpu_count() or 1)
    listener.started(inputs, [s for s, _ in shards], list(present))
    outcome = SequenceOutcome(inputs, [], sum(present.values()), 0, sum(present.values()), [], 0.0, False)

    def written(shard: int, result: SequenceResult) -> None:
        found = len(result)
        outcome.written.append(files[shard])
        outcome.made += found
        outcome.rows += found
        outcome.results.append(result)
        listener.wrote(shard, files[shard], result)
        result.levels = []

    with BackgroundWriter(written) as writer:
        for shard, rows in shards:
            if shard in present:
                outcome.starved |= present[shard] < rows
                continue
            if listener.cancelled():
                outcome.cancelled = True
                break
            result = make_sequences(
                pipeline,
                inputs,
                shard,
                rows,
                workers,
                cancelled=listener.cancelled,
                progress=lambda found, running, shard=shard: listener.advanced(shard, found, running),
                verdicts=simulated(inputs, job.physics) if job.physics else None,
            )
            if result.cancelled:
                outcome.cancelled = True
                break
            outcome.starved |= len(result) < rows
            if not len(result):  # nothing to write; nor will the next shards give any
                outcome.results.append(result)
                break
            writer.put(shard, files[shard], _shard(job, inputs, keys, meshes, key, shard, result), result)
    outcome.paths = [files[s] for s, _ in shards if s in present or files[s] in outcome.written]
    outcome.wall = time.perf_counter() - start
    return outcome


def simulated(inputs: SequenceInputs, physics: str) -> Verdicts:
    """A function that simulates the rows of the last of some levels, on all cores."""
    protocol, scene = find_protocol(physics), inputs.scene
    assert scene is not None

    def run(levels: list[SequenceTable]) -> dict[str, np.ndarray]:
        last = replace(levels[-1], physics={})
        rows = sequence_rows([last], inputs, 0, objects=len(inputs.objects))
        return verdicts(scene, rows, protocol, threads=os.cpu_count() or 1)

    return run


def _shard(
    job: SequenceJob,
    inputs: SequenceInputs,
    keys: SequenceKeys,
    meshes: dict[str, bytes],
    key: str,
    shard: int,
    result: SequenceResult,
) -> Shard:
    protocol = ""
    if job.physics and inputs.scene:
        protocol = protocol_text(inputs.scene, find_protocol(job.physics))
    return Shard(
        header=ShardHeader(
            pipeline=job.pipeline.name,
            seed=job.pipeline.seed,
            shard_index=shard,
            config={
                "run_key": key,
                "pipeline": job.pipeline.describe(),
                "bounds": job.pipeline.bounds.describe(),
                "objects": list(job.objects),
                "scales": list(keys.scales),
                "shard_rows": job.shard_rows,
                "physics": job.physics,
                **hand_config(keys.source),
            },
        ),
        hand=hand_record(inputs.hand, meshes),
        objects=object_records(inputs),
        grasps=sequence_rows(result.levels, inputs, shard, protocol),
        statistics=_statistics(inputs, result),
    )


def _statistics(inputs: SequenceInputs, result: SequenceResult) -> dict[str, Any]:
    flat: dict[str, Any] = {
        "device": inputs.device.name,
        "sequences": len(result),
        "rounds": result.rounds,
        "duplicates_dropped": result.duplicates,
        "exhausted": int(result.exhausted),
        "seconds_wall": result.wall,
    }
    for step, found in enumerate(result.reached, 1):
        flat[f"found_{step}"] = found
    return flat | flat_statistics(result.counts, result.seconds)

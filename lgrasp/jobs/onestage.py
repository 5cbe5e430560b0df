"""One batch of candidates up to one stage, every table read from and written to the cache by content key."""

import json
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.engine.batch import run_stage
from lgrasp.engine.cache import Cache, content_key
from lgrasp.engine.inputs import InputKeys, input_keys, load_inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.registry import STAGES
from lgrasp.engine.run import Job
from lgrasp.engine.shard import STREAM, shard_context
from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import CandidateTable, ContactSets, DeviceTable, PoseTable, grasp_arrays
from lgrasp.jobs.hands import for_hand, hand_source
from lgrasp.runtime.device import resolve_device
from lgrasp.runtime.kernels import kernel_modules, load_kernels
from lgrasp.runtime.tally import Meter

_ELSE = {
    **dict.fromkeys(("domain", "ik", "wrap"), ("adjust", "close")),
    "adjust": ("ik",),
}
"""Stages that a hand has in place of others, and these."""


@dataclass(frozen=True)
class StageRun:
    """Result of one stage."""

    stage: str
    hit: bool
    counts: dict[str, int]  # survivors as the stage reports them
    seconds: float  # 0 when the table was read from the cache
    path: Path


def run_up_to(
    last: str,
    pipeline: Pipeline,
    hand: str,
    mesh: str,
    first: int,
    count: int,
    shard: int,
    cache: Cache,
    *,
    scale: float,
    device: str,
) -> list[StageRun]:
    """Tables of the stages up to ``last`` for candidates ``first .. first + count - 1`` of a shard's stream.

    Nothing is computed when the table of ``last`` is in the cache; else the latest one that is there is the start.

    Args:
        hand, mesh: name or path.
        scale: factor from the mesh's unit to metres.

    Raises:
        LgraspError: bad input.
    """
    if last not in pipeline.order:
        raise ConfigError(f"pipeline {pipeline.name} has no stage {last}; its stages: {', '.join(pipeline.order)}")
    if first + count > STREAM:
        raise ConfigError(f"candidates {first:,} to {first + count - 1:,}: those below {STREAM:,} are accepted")
    if pipeline.open_to_hands:
        pipeline = pipeline.closing() if last == "close" else pipeline.without(*_ELSE.get(last, ()))
    pipeline, used = for_hand(pipeline, hand), resolve_device(device)
    keys = input_keys(hand_source(hand), mesh, scale, pipeline.object, pipeline.field, pipeline.hand)
    stages = pipeline.order[: pipeline.order.index(last) + 1]
    files = _stage_keys(pipeline, keys, stages, first, count, shard)
    found = {stage: arrays for stage in stages if (arrays := cache.load(stage, files[stage])) is not None}
    runs = [
        StageRun(stage, True, json.loads(str(arrays["counts"])), 0.0, cache.path(stage, files[stage]))
        for stage, arrays in found.items()
    ]
    done = stages.index([*found][-1]) + 1 if found else 0
    if done == len(stages):
        return runs
    inputs = load_inputs(
        *(cache, keys, scale, pipeline.object, pipeline.field, used), table=pipeline.on_table, steer=pipeline.steer
    )
    context = shard_context(pipeline, inputs, shard)
    table: Any = _table(found[stages[done - 1]], used.alias) if done else (first, count)
    load_kernels(used.alias, kernel_modules(*Job.kernels))
    for stage in stages[done:]:
        start = time.perf_counter()
        meter = Meter(used.alias)
        table = run_stage(stage, table, pipeline, context, meter)
        counted = meter.counts[stage]
        seconds = time.perf_counter() - start
        arrays = table.arrays() if isinstance(table, DeviceTable) else grasp_arrays(table)
        cache.store(stage, files[stage], arrays | {"counts": np.asarray(json.dumps(counted))})
        runs.append(StageRun(stage, False, counted, seconds, cache.path(stage, files[stage])))
    return runs


def _stage_keys(
    pipeline: Pipeline, keys: InputKeys, stages: tuple[str, ...], first: int, count: int, shard: int
) -> dict[str, str]:
    """Content key of each stage's table; it holds the key of the table before."""
    made: dict[str, str] = {}
    before = content_key("start", 1, inputs=[keys.hand, keys.object, keys.field], candidates=[first, count])
    shared = {name: part for name, part in pipeline.describe().items() if name in ("bounds", "steer")}
    for stage in stages:
        params = pipeline.params(stage).model_dump(mode="json") | shared
        before = made[stage] = content_key(
            stage, STAGES[stage].version, params=params, seed=pipeline.seed, shard=shard, input=before
        )
    return made


def _table(arrays: dict[str, np.ndarray], device: str) -> DeviceTable:
    kind = ContactSets if "chosen" in arrays else CandidateTable if "surface" in arrays else PoseTable
    return kind.of(arrays, device)

"""One batch of candidates through the stages of a pipeline."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from lgrasp.engine.bank import Bank
from lgrasp.engine.fit import fit_params
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.registry import STAGES
from lgrasp.grasp.tables import CandidateTable, ContactSets, GraspTable, join_grasps, select_poses
from lgrasp.runtime.meter import Meter
from lgrasp.stages.context import Context


@dataclass
class BatchResult:
    """What a batch gave: grasps in candidate order, counts and seconds per stage."""

    grasps: GraspTable
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def run_stages(
    pipeline: Pipeline, context: Context, first: int | wp.array, count: int, last: str, meter: Meter | None = None
) -> Any:
    """The table of stage ``last`` for candidates ``first .. first + count - 1``, all stages before it included."""
    meter = meter or Meter(context.device)
    table: Any = (first, count)
    for stage in pipeline.order[: pipeline.order.index(last) + 1]:
        table = run_stage(stage, table, pipeline, context, meter)
    return table


def run_stage(stage: str, table: Any, pipeline: Pipeline, context: Context, meter: Meter) -> Any:
    """The table that one stage makes of another."""
    params = fit_params(stage, pipeline.params(stage), context.hand.model)
    start = meter.now()
    table, counts = STAGES[stage].run(table, params, context)
    meter.add(stage, counts, start, meter.now())
    return table


def finish_batch(pipeline: Pipeline, context: Context, sets: ContactSets, meter: Meter) -> BatchResult:
    """What a batch gives whose stages up to search have been run."""
    table: Any = sets
    for stage in pipeline.order[pipeline.order.index("search") + 1 :]:
        table = run_stage(stage, table, pipeline, context, meter)
    return BatchResult(table, meter.counts, meter.seconds)


def run_batch(pipeline: Pipeline, context: Context, first: int, count: int, bank: Bank | None = None) -> BatchResult:
    """Grasps of candidates ``first .. first + count - 1`` of a shard's stream.

    A pure function of its arguments, and of the batch alone: cutting the stream into other batches gives the same rows
    in the same order, as long as there is one pass. Later passes search the batch's candidates again, best-yielding
    poses first, so with several passes the order of the rows depends on the cut.

    Args:
        bank: where the candidates before search are kept between runs; None keeps nothing.
    """
    meter = Meter(context.device)
    at = pipeline.order.index("search")
    banked = bank.load(first, count) if bank else None
    if banked:
        table, counts = banked
        for stage, own in counts.items():
            meter.add(stage, own)
    else:
        table = run_stages(pipeline, context, first, count, pipeline.order[at - 1], meter)
        if bank:
            bank.store(first, count, table, meter.counts)
    parts = []
    passes = pipeline.params("search").passes
    for salt in range(passes):
        result: Any = table
        for stage in pipeline.order[at:]:
            result = run_stage(stage, result, pipeline, context.with_salt(salt), meter)
        parts.append(result)
        if salt == 0 and passes > 1:
            table = _richest(table, result, context)
    return BatchResult(join_grasps(parts), meter.counts, meter.seconds)


def _richest(table: CandidateTable, grasps: GraspTable, context: Context) -> CandidateTable:
    """The poses that gave grasps, those that gave most first."""
    index, number = np.unique(grasps.index, return_counts=True)
    row = np.searchsorted(table.poses.index.numpy()[: len(table.poses)], index)
    return select_poses(table, row[np.argsort(-number, kind="stable")], context.device)

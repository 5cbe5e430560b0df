"""One batch of candidates through the stages of a pipeline."""

import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lgrasp.engine.bank import Bank
from lgrasp.engine.fit import fit_params
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.stages import STAGES
from lgrasp.grasp.tables import CandidateTable, ContactSets, GraspTable, join_grasps, select_poses
from lgrasp.stages.context import Context

__all__ = ["BatchResult", "run_batch", "run_stages"]


@dataclass
class BatchResult:
    """What a batch gave: grasps in candidate order, counts and thread-seconds per stage."""

    grasps: GraspTable
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


class _Meter:
    def __init__(self) -> None:
        self.counts: dict[str, dict[str, int]] = {}
        self.seconds: dict[str, float] = {}

    def run(self, stage: str, inputs: Any, pipeline: Pipeline, context: Context, **options: Any) -> Any:
        params = fit_params(stage, pipeline.params(stage), context.hand.model)
        start = time.perf_counter()
        table, counts = STAGES[stage].run(inputs, params, context, **options)
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - start
        total = self.counts.setdefault(stage, {})
        for name, value in counts.items():
            total[name] = total.get(name, 0) + value
        return table


def run_stages(
    pipeline: Pipeline, context: Context, first: int, count: int, last: str, meter: _Meter | None = None
) -> Any:
    """The table of stage ``last`` for candidates ``first .. first + count - 1``, all stages before it included."""
    meter = meter or _Meter()
    table: Any = (first, count)
    for stage in pipeline.order:
        options = {"realised": _realised(pipeline)} if stage == "search" else {}
        table = meter.run(stage, table, pipeline, context, **options)
        if stage == last:
            return table
    raise AssertionError(f"stage {last} is not in the pipeline")


def _realised(pipeline: Pipeline) -> bool:
    """Does ik come before search in this pipeline?"""
    return pipeline.order.index("ik") < pipeline.order.index("search")


def run_batch(pipeline: Pipeline, context: Context, first: int, count: int, bank: Bank | None = None) -> BatchResult:
    """Grasps of candidates ``first .. first + count - 1`` of a shard's stream.

    A pure function of its arguments, and of the batch alone: cutting the stream into other batches gives the same rows
    in the same order, as long as there is one pass. Later passes search the batch's candidates again, best-yielding
    poses first, so with several passes the order of the rows depends on the cut.

    Args:
        bank: where the candidates before search are kept between runs; None keeps nothing.
    """
    meter = _Meter()
    before_search = pipeline.order[pipeline.order.index("search") - 1]
    banked = bank.load(first, count) if bank else None
    if banked:
        table, meter.counts = banked
    else:
        table = run_stages(pipeline, context, first, count, before_search, meter)
        if bank:
            bank.store(first, count, table, meter.counts)
    parts = []
    for salt in range(pipeline.params("search").passes):
        sets = meter.run("search", table, pipeline, context, realised=_realised(pipeline), salt=salt)
        grasps = _finish(sets, pipeline, context, meter)
        parts.append(grasps)
        if salt == 0 and pipeline.params("search").passes > 1:
            table = _richest(table, grasps, context)
    return BatchResult(join_grasps(parts), meter.counts, meter.seconds)


def _finish(sets: ContactSets, pipeline: Pipeline, context: Context, meter: _Meter) -> GraspTable:
    for stage in pipeline.order[pipeline.order.index("search") + 1 :]:
        sets = meter.run(stage, sets, pipeline, context)
    assert isinstance(sets, GraspTable)
    return sets


def _richest(table: CandidateTable, grasps: GraspTable, context: Context) -> CandidateTable:
    """The poses that gave grasps, those that gave most first."""
    index, number = np.unique(grasps.index, return_counts=True)
    row = np.searchsorted(table.poses.index.numpy(), index)
    return select_poses(table, row[np.argsort(-number, kind="stable")], context.device)

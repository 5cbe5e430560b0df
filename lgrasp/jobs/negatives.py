"""Failed rows beside grasps: negatives for those who train a classifier."""

import math
from dataclasses import replace

import numpy as np

from lgrasp.engine.batch import block_size, run_stages
from lgrasp.engine.inputs import Inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.shard import shard_context, shard_effort
from lgrasp.grasp.bounds import ANY_CLOSING, ANY_PENETRATION, ANY_SWEEP
from lgrasp.grasp.row_order import RowOrder
from lgrasp.grasp.tables import GraspTable, join_rows, take_rows, widen_grasps
from lgrasp.runtime.kept import Keeper
from lgrasp.stages.filter.failed import failed_rows

_PER_POSE = 2
"""Sets of contacts that are tried at a pose: negatives are of about as many poses as grasps."""

_LOOSE: dict[str, float] = {
    "max_gap": 0.004,
    "max_normal_angle": 45.0,
    "max_normal_spread": 60.0,
    "max_penetration": 0.01,
    "allowed_penetration": 0.005,
    "max_gswo": 0.5,
    "max_unresisted_load": 1.0,
    "min_epsilon": 0.0,
    "min_force_share": 0.0,
    "min_squeeze_travel": 0.0,
    "min_stable_squeeze": 0.0,
    "min_stable_pinch": 0.0,
    "max_closing_travel": ANY_CLOSING,
    "max_closing_penetration": ANY_PENETRATION,
    "max_closing_sweep": ANY_SWEEP,
    "min_pregrasp_opening": 0.0,
    "min_table_distance": 0.0,
    "min_self_distance": 0.0,
}
"""Bounds within which negatives are searched, as grasps are within theirs; wider ones of a pipeline stay."""


def with_negatives(grasps: GraspTable, pipeline: Pipeline, inputs: Inputs, shard: int, share: float) -> GraspTable:
    """The grasps of a shard, and after them rows that fail a bound; metrics ``valid`` and ``failed_bound`` tell.

    Which rows depends on how many there are, and on nothing else that may differ between runs of one pipeline.

    Args:
        share: failed rows for each grasp; there are fewer where the shard's candidates have no more.
    """
    count = math.ceil(share * len(grasps))
    passed = _marked(grasps, failed_bound=np.zeros(len(grasps), np.float32))
    found = _marked(_failed(pipeline, inputs, shard, count), passed)
    width = max(grasps.contact_links.shape[1], found.contact_links.shape[1])
    return join_rows([widen_grasps(table, width) for table in (passed, found)])


def _marked(table: GraspTable, like: GraspTable | None = None, **metrics: np.ndarray) -> GraspTable:
    """The table with metric ``valid``, and the metrics that another has, NaN where they were not measured."""
    metrics = {**table.metrics, **metrics}
    metrics["valid"] = (metrics["failed_bound"] == 0).astype(np.float32)
    missing = np.full(len(table), np.nan, np.float32)
    metrics = metrics if like is None else {name: metrics.get(name, missing) for name in like.metrics}
    return replace(table, metrics=metrics)


def _failed(pipeline: Pipeline, inputs: Inputs, shard: int, count: int) -> GraspTable:
    """Failed rows of the first candidates of a shard that have so many, in random order."""
    bounds, loose = pipeline.bounds, _loosened(pipeline)
    own = replace(inputs, kept=inputs.kept.get("negatives", "", Keeper))  # a GPU replays what was kept for grasps
    context, block = shard_context(loose, own, shard), block_size(pipeline)
    last = pipeline.order[pipeline.order.index("filter") - 1]
    parts, rows = [], 0
    for first in range(0, shard_effort(pipeline, count), block):
        sets = run_stages(loose, context, first, block, last)
        parts.append(failed_rows(sets, pipeline.params("filter"), context, bounds, _PER_POSE))
        rows += len(parts[-1])
        if rows >= count:
            break
    table = join_rows(parts)
    order = RowOrder(pipeline.seed, shard, block)
    return take_rows(table, order.shuffled(table.index, table.slot)[:count])


def _loosened(pipeline: Pipeline) -> Pipeline:
    """The pipeline with wider bounds, and without what would take long to be stricter."""
    own = pipeline.bounds
    wider = {n: max(x, getattr(own, n)) if n.startswith(("max", "allowed")) else x for n, x in _LOOSE.items()}
    loose = pipeline.with_bounds(**wider)
    loose = loose.with_params("search", check_depth=False, passes=1)
    return loose.with_params("domain", rounds=1) if "domain" in loose.order else loose

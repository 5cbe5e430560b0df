"""One batch of candidates through the stages of a pipeline."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp

from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.registry import STAGES
from lgrasp.errors import ConfigError
from lgrasp.grasp.schema import PASS_SHIFT
from lgrasp.grasp.tables import CandidateTable, ContactSets, GraspTable, PoseTable, join_rows, select_poses, take_rows
from lgrasp.hand.model import HandModel
from lgrasp.runtime.fetch import fetch, to_numpy
from lgrasp.runtime.tally import Meter
from lgrasp.stages.context import Context
from lgrasp.steer.arrays import SteerArrays

Search = Callable[[Context, int, int], tuple[ContactSets, Meter]]
"""(context, first candidate, number of candidates) -> what search makes of them, counted."""

PASS_BLOCK = 64
"""Candidates that later passes search again before the next ones start: it decides the order of the rows."""
_BLOCK = 256  # candidates of a block where there is one pass
_RARE = 20  # where more than one pose in so many gives grasps, poses drawn anew are as good as moved ones
_NUMBERS = 2**31  # of moved poses: those of candidates have as many bits
_MOVED_SETTINGS = 2  # of shared joints at moved poses: others than those of the pose that was moved rarely help


@dataclass
class BatchResult:
    """Result of a batch: grasps in candidate order, counts and seconds per stage."""

    grasps: GraspTable
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)


def block_size(pipeline: Pipeline) -> int:
    """Candidates of a block: batches are whole blocks, and a shard that ends inside one takes a random part of it.

    Smaller where a candidate takes long.
    """
    slow = pipeline.params("search").passes > 1 or bool({"hold", "simulate"} & {*pipeline.order})
    return PASS_BLOCK if slow else _BLOCK


def run_stages(
    pipeline: Pipeline, context: Context, first: int | wp.array, count: int, last: str, meter: Meter | None = None
) -> Any:
    """The table of stage ``last`` for candidates ``first .. first + count - 1``, all stages before it included."""
    stages = pipeline.order[: pipeline.order.index(last) + 1]
    return _run_through(stages, (first, count), pipeline, context, meter or Meter(context.device))


def run_stage(stage: str, table: Any, pipeline: Pipeline, context: Context, meter: Meter) -> Any:
    """The table that one stage makes of another; where contacts are drawn in rounds, of all rounds."""
    table = _run_once(stage, table, pipeline, context, meter)
    if stage == "ik" and pipeline.realised:
        for n in range(1, pipeline.params("domain").rounds):
            for part in ("domain", "ik"):
                table = _run_once(part, table, pipeline, context.changed(round=n), meter)
    return table


def _run_once(stage: str, table: Any, pipeline: Pipeline, context: Context, meter: Meter) -> Any:
    params = _fitted(stage, pipeline.params(stage), context.hand.model, context.steered)
    start = meter.now()
    table, counts = STAGES[stage].run(table, params, context)
    meter.add(stage, counts, start, meter.now())
    return table


def _fitted(stage: str, params: Any, hand: HandModel, steer: SteerArrays) -> Any:
    """The parameters of a stage for a hand: how many finger contacts search asks for.

    A hand's own wish (hand.yaml: contacts) stands in for the default of search, and no more contacts are asked for than
    there are fingers: asking three of a gripper with two jaws would give nothing. Where a steering names the fingers,
    it tells how many. A pure function of parameters, hand and steering, all of which are in the content keys.

    Raises:
        ConfigError: a steering leaves fewer fingers than the parameters ask for.
    """
    if stage != "search":
        return params
    asked = params.contacts
    if hand.contacts and params.usual_contacts:
        asked = hand.contacts
    touching = np.diff(hand.contact_first).reshape(-1, hand.groups + 1)[:, :-1] > 0
    fingers = int((touching & steer.touching.groups).sum(1).max())
    if not (params.usual_contacts or steer.least or steer.touching.groups.all()) and min(asked) > fingers:
        raise ConfigError(
            f"steer.links leaves {fingers} fingers of hand '{hand.name}', and search.contacts asks for {min(asked)} or "
            f"more; give --contacts {fingers}, or more links"
        )
    contacts = (steer.least,) if steer.least else tuple(min(k, max(2, fingers)) for k in asked)
    return params if contacts == params.contacts else params.model_copy(update={"contacts": contacts})


def run_batch(
    pipeline: Pipeline, context: Context, first: int, count: int, search: Search | None = None
) -> BatchResult:
    """Grasps of candidates ``first .. first + count - 1`` of a shard's stream.

    A pure function of its arguments, and of the batch alone: cutting the stream into other batches gives the same rows
    in the same order. With several passes the poses that yielded are searched again, in every block of PASS_BLOCK
    candidates after one another and the best-yielding first; batches are then whole blocks. Rows of pass p have
    ``p << PASS_SHIFT`` added to the number of their candidate. Where few poses of a block give grasps, poses near those
    that do come after it (``close.moves``), their rows as of further passes.

    Args:
        search: runs the stages up to search, such as :meth:`GraphCache.run`; None launches them one by one.
    """
    if search:
        sets, meter = search(context, first, count)
    else:
        meter = Meter(context.device)
        sets = run_stages(pipeline, context, first, count, "search", meter)
    grasps = _run_through(pipeline.order[pipeline.order.index("search") + 1 :], sets, pipeline, context, meter)
    passes, parts = pipeline.params("search").passes, [grasps]
    if passes > 1:
        table = _yielding(sets.candidates, grasps, context.device)
        again = pipeline.order[pipeline.order.index("search") :]
        for salt in range(1, passes):
            found = _run_through(again, table, pipeline, context.with_salt(salt), meter)
            parts.append(replace(found, index=found.index + (salt << PASS_SHIFT)))
    if pipeline.moves:
        parts += _near(sets.candidates.poses, grasps, pipeline, context, meter)
    if len(parts) > 1:
        grasps = _by_blocks(join_rows(parts), block_size(pipeline))
    return BatchResult(grasps, meter.counts, meter.seconds)


def _run_through(stages: Sequence[str], table: Any, pipeline: Pipeline, context: Context, meter: Meter) -> Any:
    for stage in stages:
        table = run_stage(stage, table, pipeline, context, meter)
    return table


def _yielding(table: CandidateTable, grasps: GraspTable, device: str) -> CandidateTable:
    """The poses that gave grasps: block by block, those that gave most first."""
    index, number = np.unique(grasps.index, return_counts=True)
    row = np.searchsorted(to_numpy(table.poses.index)[: len(table.poses)], index)
    return select_poses(table, row[np.lexsort((-number, index // PASS_BLOCK))], device)


def _near(table: PoseTable, grasps: GraspTable, pipeline: Pipeline, context: Context, meter: Meter) -> list[GraspTable]:
    """Grasps at poses near those that gave some, in blocks where few did."""
    from lgrasp.stages.place.near import near_poses  # as stages, where it is used

    most, block = pipeline.moves, block_size(pipeline)
    index, palm = fetch([table.index, table.palm_point])
    index = index[: len(table)]
    at = np.searchsorted(index, np.unique(grasps.index))
    at = at[(palm[at] >= 0) & (index[at] < _NUMBERS // most)]
    _, of, number = np.unique(index[at] // block, return_inverse=True, return_counts=True)
    at = at[number[of] * _RARE <= block]
    if not len(at):
        return []
    rows, nth = np.repeat(at, most), np.tile(np.arange(most), len(at))
    start = meter.now()
    poses, counts = near_poses(table, rows, index[rows] * most + nth, pipeline.params("place"), context)
    meter.add("place", counts, start, meter.now())
    settings = min(_MOVED_SETTINGS, pipeline.params("close").settings)
    found = _run_through(pipeline.order[1:], poses, pipeline.with_params("close", settings=settings), context, meter)
    candidate, nth = np.divmod(found.index, most)
    return [replace(found, index=candidate + ((pipeline.params("search").passes + nth) << PASS_SHIFT))]


def _by_blocks(grasps: GraspTable, size: int) -> GraspTable:
    """Rows in the order of their blocks, within a block as they are: pass by pass."""
    block = (grasps.index & ((1 << PASS_SHIFT) - 1)) // size
    return take_rows(grasps, np.argsort(block, kind="stable"))

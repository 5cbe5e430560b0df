"""One round: sequences begun together, object by object."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace

import numpy as np

from lgrasp.engine.batch import run_stages
from lgrasp.engine.meter import Meter
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.sequence.inputs import SequenceInputs
from lgrasp.engine.shard import add_counts
from lgrasp.grasp.held import hold
from lgrasp.grasp.sequences import SequenceTable, empty_sequences, join_sequences, take_sequences
from lgrasp.grasp.tables import GraspTable, join_grasps, sort_grasps
from lgrasp.seeding import stage_seed
from lgrasp.stages.context import Context
from lgrasp.stages.sequence.policy import choose_spaces
from lgrasp.stages.sequence.stage import go_on
from lgrasp.stages.sequence.stage import run as grow

__all__ = ["Round", "Verdicts", "run_round"]

_CPU_CHUNK = 1024  # candidates of a thread at a time
_FIRST_WAVE = 64  # candidates that every sequence is given
_CHOICE = 4  # grasps among which policy lookahead chooses, for each that goes on

Verdicts = Callable[[list[SequenceTable]], dict[str, np.ndarray]]
"""Columns of a simulator for the rows of the last of some levels; the one whose name ends with ``_holds`` decides."""


@dataclass
class Round:
    """What a round gave: level n holds the rows of n + 1 objects; their parents are rows of the level before."""

    levels: list[SequenceTable] = field(default_factory=list)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    spaces: list[dict[str, dict[str, dict[str, int]]]] = field(default_factory=list)  # step, space, stage: survivors

    def add(self, space: str, counts: dict[str, dict[str, int]]) -> None:
        """Count survivors of the step that is being made."""
        add_counts(self.counts, counts)
        add_counts(self.spaces[-1].setdefault(space, {}), counts)


def run_round(
    pipeline: Pipeline,
    inputs: SequenceInputs,
    shard: int,
    number: int,
    workers: int,
    cancelled: Callable[[], bool] = lambda: False,
    verdicts: Verdicts | None = None,
) -> Round:
    """Sequences of round ``number`` of a shard: a pure function of its arguments but the number of threads.

    Args:
        workers: threads.
        cancelled: asked before each step; the round then ends early.
        verdicts: simulates the rows of each step; only those that hold go on.
    """
    params, model = pipeline.params("sequence"), inputs.hand
    seed = stage_seed(pipeline.seed, shard, "sequence", number)
    rows = empty_sequences(params.width, model.dofs, model.groups + 1)
    result = Round()
    with ThreadPoolExecutor(workers) as pool:
        while rows.steps < len(inputs.objects) and len(rows) and not cancelled():
            result.spaces.append({})
            rows = _step(pipeline, inputs, rows, seed, pool, result)
            result.levels.append(rows)
            if verdicts and len(rows):
                result.levels[-1] = rows = _that_hold(rows, verdicts(result.levels), inputs, result)
    return result


def _step(
    pipeline: Pipeline,
    inputs: SequenceInputs,
    rows: SequenceTable,
    seed: int,
    pool: ThreadPoolExecutor,
    result: Round,
) -> SequenceTable:
    """The rows that are one object longer, by row that they go on from."""
    params, step = pipeline.params("sequence"), rows.steps
    row, space = choose_spaces(rows, inputs.spaces, params.policy, len(inputs.objects) - step - 1, seed)
    parts: list[SequenceTable] = []
    for number in np.unique(space):
        chosen = row[space == number]
        before = take_sequences(rows, chosen)
        seeds = [stage_seed(seed, step, inputs.spaces[number].name, wave) for wave in range(len(_waves(params.tries)))]
        grasps = _grasps(pipeline, inputs, before, int(number), seeds, pool, result)
        context = _context(inputs, before, int(number), params.tries, seeds[0])
        longer, counts = grow((before, int(number), grasps), params, context)
        result.add(inputs.spaces[number].name, {"sequence": counts})
        candidate = chosen[longer.parent] * params.tries + longer.candidate % params.tries
        parts.append(replace(longer, parent=chosen[longer.parent], candidate=candidate))
    if not parts:
        return take_sequences(rows, np.zeros(0, int))
    table = join_sequences(parts)
    table = take_sequences(table, np.argsort(table.parent, kind="stable"))
    return take_sequences(table, go_on(table.parent, table.metrics["room"], params))


def _waves(tries: int) -> list[int]:
    """Candidates of each sequence that are tried one after another, until some grasp is found."""
    waves = [min(_FIRST_WAVE, tries)]
    while sum(waves) < tries:
        waves.append(min(3 * sum(waves), tries - sum(waves)))
    return waves


def _context(inputs: SequenceInputs, before: SequenceTable, number: int, tries: int, seed: int) -> Context:
    """What stages are given to go on from some sequences with an opposition space."""
    space, view, step = inputs.spaces[number], inputs.views[number], before.steps
    posture, frozen = before.posture(inputs.hand.tree), before.used | ~space.joints
    holding = hold(view.hand, posture, frozen, inputs.objects[:step], before.pose, tries=tries)
    alias = inputs.device.alias
    return Context(view.hand, inputs.objects[step], view.field, alias, seed, 0, space=space, holding=holding)


def _grasps(
    pipeline: Pipeline,
    inputs: SequenceInputs,
    before: SequenceTable,
    number: int,
    seeds: list[int],
    pool: ThreadPoolExecutor,
    result: Round,
) -> GraspTable:
    """Grasps of the next object with an opposition space; candidates are counted through ``before``, ``tries`` a row.

    Rows that have as many grasps as they may go on with are not tried any further.
    """
    params, name = pipeline.params("sequence"), inputs.spaces[number].name
    enough = params.branch * (_CHOICE if params.policy == "lookahead" else 1)
    found, have, done = [], np.zeros(len(before), int), 0
    for tries, seed in zip(_waves(params.tries), seeds, strict=True):
        pending = np.flatnonzero(have < enough)
        if not len(pending):
            break
        context = _context(inputs, take_sequences(before, pending), number, tries, seed)
        grasps, meters = _from_field(pipeline, context, len(pending) * tries, pool)
        for meter in meters:
            result.add(name, meter.counts)
            for stage, seconds in meter.seconds.items():
                result.seconds[stage] = result.seconds.get(stage, 0.0) + seconds
        row = pending[grasps.index // tries]
        found.append(replace(grasps, index=row * params.tries + done + grasps.index % tries))
        have += np.bincount(row, minlength=len(before))
        done += tries
    whole = join_grasps(found)
    return sort_grasps(whole)


def _from_field(
    pipeline: Pipeline, context: Context, candidates: int, pool: ThreadPoolExecutor
) -> tuple[GraspTable, list[Meter]]:
    """Grasps of all candidates that go on from the held rows; on a CPU several chunks of them at a time."""
    size = _CPU_CHUNK if context.device == "cpu" else candidates
    meters = [Meter(context.device) for _ in range(0, candidates, size)]

    def run(number: int) -> GraspTable:
        first = number * size
        return run_stages(pipeline, context, first, min(size, candidates - first), "filter", meters[number])

    return join_grasps(list(pool.map(run, range(len(meters))))), meters


def _that_hold(
    rows: SequenceTable, columns: dict[str, np.ndarray], inputs: SequenceInputs, result: Round
) -> SequenceTable:
    holds = next(values for name, values in columns.items() if name.endswith("_holds")).astype(bool)
    for number, space in enumerate(inputs.spaces):
        own = rows.space[:, -1] == number
        if own.any():
            counts = {"tried": int(own.sum()), "held": int(holds[own].sum())}
            result.add(space.name, {"validate": counts})
    return take_sequences(rows, np.flatnonzero(holds), physics=columns)

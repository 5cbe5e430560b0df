"""One round: sequences started together, object by object."""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace
from typing import TYPE_CHECKING

import numpy as np

from lgrasp.engine.batch import run_stage, run_stages
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.held import hold
from lgrasp.grasp.predicted import TouchingGrasps, upload_predicted
from lgrasp.grasp.sequences import HeldHands, SequenceTable, empty_sequences
from lgrasp.grasp.tables import GraspTable, join_rows, take_rows
from lgrasp.jobs.sequence.inputs import SequenceInputs
from lgrasp.runtime.fetch import fetch
from lgrasp.runtime.tally import Meter, add_counts, add_seconds
from lgrasp.seeding import stage_seed
from lgrasp.sequence.policy import space_orders
from lgrasp.sequence.stage import go_on
from lgrasp.sequence.stage import run as grow
from lgrasp.sequence.touching_sets import touching_sets
from lgrasp.stages.context import Context

if TYPE_CHECKING:  # torch takes a second to import
    from lgrasp.learn.diffuser.sampler import DrawnSteps
    from lgrasp.sequence.optimiser.optimise import Optimised

_CPU_CHUNK = 1024  # candidates of a thread at a time
_LOOKAHEAD_CHOICES = 4  # grasps among which policy lookahead chooses, for each that is continued

Verdicts = Callable[[list[SequenceTable]], dict[str, np.ndarray]]
"""Columns of a simulator for the rows of the last of some levels; the one whose name ends with ``_holds`` decides."""


Spaces = list[dict[str, dict[str, dict[str, int]]]]
"""Survivors by step, opposition space and stage."""


@dataclass
class Round:
    """Result of a round: level n holds the rows of n + 1 objects; their parents are rows of the level before."""

    levels: list[SequenceTable] = field(default_factory=list)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)  # thread-seconds per stage
    spaces: Spaces = field(default_factory=list)
    walls: list[float] = field(default_factory=list)  # of each step, simulation not counted [s]

    def count(self, space: str, counts: dict[str, dict[str, int]], seconds: Mapping[str, float] | None = None) -> None:
        """Count survivors of the step that is being made, and thread-seconds."""
        add_counts(self.counts, counts)
        add_counts(self.spaces[-1].setdefault(space, {}), counts)
        add_seconds(self.seconds, seconds or {})


def add_spaces(total: Spaces, more: Spaces) -> None:
    """Add survivors to a running total."""
    total += [{} for _ in more[len(total) :]]
    for into, found in zip(total, more, strict=False):
        for space, counts in found.items():
            add_counts(into.setdefault(space, {}), counts)


def run_round(
    pipeline: Pipeline,
    inputs: SequenceInputs,
    shard: int,
    number: int,
    workers: int,
    tell: Callable[[float], None] = lambda share: None,
    verdicts: Verdicts | None = None,
    *,
    begun: int | None = None,
) -> Round:
    """Sequences of round ``number`` of a shard: a pure function of its arguments but the number of threads.

    What becomes of a sequence does not depend on those after it: begun with fewer, a round has the first of its rows.

    Args:
        workers: threads.
        tell: called with the share of the round that is done; what it raises ends the round.
        verdicts: simulates the rows of each step; only those that hold are continued.
        begun: sequences that are started; None: the pipeline's width.
    """
    model, result = inputs.hand, Round()
    seed = stage_seed(pipeline.seed, shard, "sequence", number)
    rows = empty_sequences(begun or pipeline.params("sequence").width, model.dofs, model.groups + 1)
    with ThreadPoolExecutor(workers) as pool:
        while rows.steps < len(inputs.objects) and len(rows):
            tell(rows.steps / len(inputs.objects))
            result.spaces.append({})
            start = time.perf_counter()
            rows = _Step(pipeline, inputs, rows, seed, pool, result, tell).run()
            result.walls.append(time.perf_counter() - start)
            result.levels.append(rows)
            if verdicts and len(rows):
                result.levels[-1] = rows = _that_hold(rows, verdicts(result.levels), inputs, result)
    return result


class _Step:
    """Grasps of the next object for some sequences, wave by wave of candidates, until each has enough."""

    def __init__(
        self,
        pipeline: Pipeline,
        inputs: SequenceInputs,
        rows: SequenceTable,
        seed: int,
        pool: ThreadPoolExecutor,
        result: Round,
        tell: Callable[[float], None],
    ) -> None:
        self._pipeline, self._inputs, self._rows, self._seed = pipeline, inputs, rows, seed
        self._pool, self._result, self._tell = pool, result, tell
        self._params = pipeline.params("sequence")
        self._have = np.zeros(len(rows), int)
        self._found: dict[int, list[GraspTable]] = {}
        self._tried: dict[int, np.ndarray] = {}  # rows that were continued with each space, (N,) bool

    def run(self) -> SequenceTable:
        """The rows that are one object longer, by the row that they extend."""
        rows, params = self._rows, self._params
        left = len(self._inputs.objects) - rows.steps - 1
        order = space_orders(rows, self._inputs.spaces, params.policy, left, self._seed)
        if not params.in_waves:
            self._one_each(order[:, 0])
        for wave in range(params.waves if params.in_waves else 0):
            self._tell((rows.steps + wave / params.waves) / len(self._inputs.objects))
            space = order[np.arange(len(rows)), wave % np.maximum((order >= 0).sum(1), 1)]
            chosen = np.flatnonzero((space >= 0) & self._wanting)
            if not len(chosen):
                continue
            drawn = self._drawn(chosen, space[chosen], params.wave, wave) if params.method == "diffuser" else None
            for number in np.unique(space[chosen]):
                own = space[chosen] == number
                self._go_on(chosen[own], int(number), wave, drawn.of_hands(own) if drawn else None)
        if not self._tried:
            return take_rows(rows, np.zeros(0, int))
        table = join_rows([self._longer(number) for number in sorted(self._tried)])
        table = take_rows(table, np.argsort(table.parent, kind="stable"))
        return take_rows(table, go_on(table.parent, table.metrics["room"], params))

    @property
    def _wanting(self) -> np.ndarray:
        """Rows that have not enough grasps yet, (N,) bool."""
        return self._have < self._params.branch * (_LOOKAHEAD_CHOICES if self._params.policy == "lookahead" else 1)

    def _go_on(self, chosen: np.ndarray, number: int, wave: int, drawn: "DrawnSteps | None") -> None:
        """Give some rows a wave of candidates with a space, those that were drawn for them if any were."""
        name, size = self._inputs.spaces[number].name, self._params.wave
        seed = stage_seed(self._seed, self._rows.steps, name, wave)
        context = self._context(chosen, number, size, seed)
        if drawn is not None:
            view = self._inputs.views[number]
            given = context.object, self._inputs.spaces[number].groups, view.records, drawn.pose, drawn.q
            context = context.changed(predicted=upload_predicted(view.hand, *given))
        grasps, meters = self._from_stages(context, len(chosen) * size)
        self._take(grasps, meters, chosen, number, size, wave * size)

    def _drawn(self, chosen: np.ndarray, space: np.ndarray, each: int, wave: int) -> "DrawnSteps":
        """Poses and postures of ``each`` candidates of some rows with their spaces, drawn at once by the network."""
        inputs, before = self._inputs, take_rows(self._rows, chosen)
        assert inputs.sampler is not None
        start = time.perf_counter()
        q, used = before.posture(inputs.hand.tree), before.used
        hands, free = HeldHands(q, used, before.pose), self._free(space) & ~used
        seed = stage_seed(self._seed, before.steps, "diffuser", wave)
        how = {"each": each, "seed": seed, "steps": self._params.draws, "pool": self._pool}
        drawn = inputs.sampler.draw(hands, space, free, **how)
        add_seconds(self._result.seconds, {"diffuser": time.perf_counter() - start})
        return drawn

    def _free(self, space: np.ndarray) -> np.ndarray:
        """Joints of spaces (N,), (N, K) bool."""
        return np.array([own.joints for own in self._inputs.spaces])[space]

    def _one_each(self, space: np.ndarray) -> None:
        """One grasp of each row with its space, by the optimiser or as the network draws it."""
        able = np.flatnonzero(space >= 0)
        if not len(able):
            return
        params, free = self._params, self._free(space[able]) & ~self._rows.used[able]
        optimised = self._optimised(able, space[able], free) if params.method != "diffuser" else None
        drawn = self._drawn(able, space[able], 1, 0) if params.method == "diffuser" else None
        for number in np.unique(space[able]):
            own, view = space[able] == number, self._inputs.views[number]
            context = self._context(able[own], int(number), 1, self._seed)
            if drawn:
                some = drawn.of_hands(own)
                sides = self._inputs.spaces[number].groups
                found = upload_predicted(view.hand, context.object, sides, view.records, *some).struct
                part = TouchingGrasps(*some, *fetch([found.hand_point, found.object_point]))
            else:
                assert optimised
                part = replace(optimised, **{f.name: getattr(optimised, f.name)[own] for f in fields(optimised)})
            meter = Meter(context.device)
            sets = touching_sets(part, free[own], context)
            table = run_stage("filter", sets, self._pipeline, context, meter)
            self._take(table, [meter], able[own], int(number), 1, 0)

    def _optimised(self, able: np.ndarray, space: np.ndarray, free: np.ndarray) -> "Optimised":
        from lgrasp.sequence.optimiser.optimise import optimise  # torch

        inputs, rows, params = self._inputs, self._rows, self._params
        start = time.perf_counter()
        grasps = optimise(
            inputs.hand,
            [view.hand.model for view in inputs.views],
            inputs.spaces,
            [obj.model for obj in inputs.objects[: rows.steps + 1]],
            space=space,
            q=rows.posture(inputs.hand.tree)[able],
            free=free,
            held=rows.pose[able],
            seed=np.array([stage_seed(self._seed, rows.steps, params.method, int(i)) for i in able]),
            params=params.optimiser,
            method=params.method,
            device=inputs.device.alias,
        )
        add_seconds(self._result.seconds, {params.method: time.perf_counter() - start})
        return grasps

    def _take(
        self, grasps: GraspTable, meters: list[Meter], chosen: np.ndarray, number: int, size: int, before: int
    ) -> None:
        """Keep grasps by candidates that continue ``chosen`` rows, ``size`` each, after ``before`` others."""
        for meter in meters:
            self._result.count(self._inputs.spaces[number].name, meter.counts, meter.seconds)
        row = chosen[grasps.index // size]
        candidate = row * self._params.tries + before + grasps.index % size
        self._found.setdefault(number, []).append(replace(grasps, index=candidate))
        self._tried.setdefault(number, np.zeros(len(self._rows), bool))[chosen] = True
        self._have += np.bincount(row, minlength=len(self._rows))

    def _longer(self, number: int) -> SequenceTable:
        """The sequences that continue with a space; their candidates are numbered over all rows."""
        tries, rows = self._params.tries, np.flatnonzero(self._tried[number])
        grasps = join_rows(self._found[number])
        grasps = take_rows(grasps, np.argsort(grasps.index, kind="stable"))
        place = np.searchsorted(rows, grasps.index // tries) * tries + grasps.index % tries
        context, before = self._context(rows, number, tries, self._seed), take_rows(self._rows, rows)
        table, counts = grow((before, number, replace(grasps, index=place)), self._params, context)
        self._result.count(self._inputs.spaces[number].name, {"sequence": counts})
        parent = rows[table.parent]
        return replace(table, parent=parent, candidate=parent * tries + table.candidate % tries)

    def _context(self, chosen: np.ndarray, number: int, tries: int, seed: int) -> Context:
        """Input of the stages that continue chosen rows with an opposition space."""
        inputs, before = self._inputs, take_rows(self._rows, chosen)
        space, view, step = inputs.spaces[number], inputs.views[number], before.steps
        posture, frozen = before.posture(inputs.hand.tree), before.used | ~space.joints
        return Context(
            view.hand,
            inputs.objects[step],
            view.field,
            inputs.device.alias,
            seed,
            0,
            self._pipeline.bounds,
            space=space,
            holding=hold(view.hand, posture, frozen, inputs.objects[:step], before.pose, tries=tries),
            realised=self._pipeline.realised,
        )

    def _from_stages(self, context: Context, candidates: int) -> tuple[GraspTable, list[Meter]]:
        """Grasps of all candidates that continue the held rows; on a CPU several chunks of them at a time."""
        size = _CPU_CHUNK if context.device == "cpu" else candidates
        meters = [Meter(context.device) for _ in range(0, candidates, size)]

        def run(number: int) -> GraspTable:
            first, meter = number * size, meters[number]
            return run_stages(self._pipeline, context, first, min(size, candidates - first), "filter", meter)

        return join_rows(list(self._pool.map(run, range(len(meters))))), meters


def _that_hold(
    rows: SequenceTable, columns: dict[str, np.ndarray], inputs: SequenceInputs, result: Round
) -> SequenceTable:
    holds = next(values for name, values in columns.items() if name.endswith("_holds")).astype(bool)
    for number, space in enumerate(inputs.spaces):
        own = rows.space[:, -1] == number
        if own.any():
            counts = {"tried": int(own.sum()), "held": int(holds[own].sum())}
            result.count(space.name, {"simulate": counts})
    return take_rows(replace(rows, physics=columns), np.flatnonzero(holds))

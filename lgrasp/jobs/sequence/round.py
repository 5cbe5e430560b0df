"""One round: sequences started together, object by object."""

import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from lgrasp.engine.batch import run_stage, run_stages
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.held import HeldArrays, hold
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

_CPU_CHUNK, _GPU_CHUNK = 1024, 1 << 18  # candidates at a time; on a CPU of each thread
_LOOKAHEAD_CHOICES = 4  # grasps among which policy lookahead chooses, for each that is continued

Verdicts = Callable[[list[SequenceTable]], dict[str, np.ndarray]]
"""Columns of a simulator for the rows of the last of some levels; the one whose name ends with ``_holds`` decides."""


Steps = list[dict[str, dict[str, int]]]
"""Counts by step, and by stage or opposition space."""


@dataclass
class Round:
    """Result of a round: level n holds the rows of n + 1 objects; their parents are rows of the level before."""

    levels: list[SequenceTable] = field(default_factory=list)
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)  # thread-seconds per stage
    steps: Steps = field(default_factory=list)  # survivors of stages
    spaces: Steps = field(default_factory=list)  # sequences by what became of them
    walls: list[float] = field(default_factory=list)  # of each step, simulation not counted [s]

    def count(self, counts: dict[str, dict[str, int]], seconds: Mapping[str, float] | None = None) -> None:
        """Count survivors of the step that is being made by stage, and thread-seconds."""
        add_counts(self.counts, counts)
        add_counts(self.steps[-1], counts)
        add_seconds(self.seconds, seconds or {})


def add_steps(total: Steps, more: Steps) -> None:
    """Add the counts of steps to a running total."""
    total += [{} for _ in more[len(total) :]]
    for into, found in zip(total, more, strict=False):
        add_counts(into, found)


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
            result.steps.append({})
            result.spaces.append({})
            start = time.perf_counter()
            rows = _Step(pipeline, inputs, rows, seed, pool, result, tell).run()
            result.walls.append(time.perf_counter() - start)
            result.levels.append(rows)
            if verdicts and len(rows):
                result.levels[-1] = rows = _that_hold(rows, verdicts(result.levels), inputs, result)
    return result


@dataclass
class _Step:
    """Grasps of the next object for some sequences, wave by wave of candidates, until each has enough."""

    pipeline: Pipeline
    inputs: SequenceInputs
    rows: SequenceTable
    seed: int
    pool: ThreadPoolExecutor
    result: Round
    tell: Callable[[float], None]

    def __post_init__(self) -> None:
        self.params = self.pipeline.params("sequence")
        self.have = np.zeros(len(self.rows), int)
        self.found: list[GraspTable] = []
        self.tried: list[np.ndarray] = []  # row * spaces + space of what was continued

    def run(self) -> SequenceTable:
        """The rows that are one object longer, by the row that they extend."""
        rows, params = self.rows, self.params
        left = len(self.inputs.objects) - rows.steps - 1
        order = space_orders(rows, self.inputs.spaces, params.policy, left, self.seed)
        if not params.in_waves:
            self._one_each(order[:, 0])
        for wave in range(params.waves if params.in_waves else 0):
            self.tell((rows.steps + wave / params.waves) / len(self.inputs.objects))
            space = order[np.arange(len(rows)), wave % np.maximum((order >= 0).sum(1), 1)]
            chosen = np.flatnonzero((space >= 0) & self._wanting)
            if len(chosen):
                self._go_on(chosen, space[chosen], wave)
        if not self.tried:
            return take_rows(rows, np.zeros(0, int))
        table = self._longer()
        return take_rows(table, go_on(table.parent, table.metrics["room"], params))

    @property
    def _wanting(self) -> np.ndarray:
        """Rows that have not enough grasps yet, (N,) bool."""
        return self.have < self.params.branch * (_LOOKAHEAD_CHOICES if self.params.policy == "lookahead" else 1)

    def _go_on(self, chosen: np.ndarray, space: np.ndarray, wave: int) -> None:
        """Give some rows a wave of candidates with their spaces."""
        size, view = self.params.wave, self.inputs.view
        context = self._context(chosen, space, size, stage_seed(self.seed, self.rows.steps, "wave", wave))
        if self.params.method == "diffuser":
            drawn = self._drawn(chosen, context.held, size, wave)
            predicted = upload_predicted(view.hand, context.object, context.held, view.records, *drawn)
            context = context.changed(predicted=predicted)
        grasps, meters = self._from_stages(context, len(chosen) * size)
        self._take(grasps, meters, chosen, space, size, wave * size)

    def _drawn(self, chosen: np.ndarray, held: HeldArrays, each: int, wave: int) -> "DrawnSteps":
        """Poses and postures of ``each`` candidates of some rows with their spaces, drawn at once by the network."""
        inputs, before = self.inputs, take_rows(self.rows, chosen)
        assert inputs.sampler is not None
        assert held.space is not None
        start = time.perf_counter()
        hands = HeldHands(before.posture(inputs.hand.tree), before.used, before.pose)
        seed = stage_seed(self.seed, before.steps, "diffuser", wave)
        how: dict[str, Any] = {"each": each, "seed": seed, "steps": self.params.draws, "pool": self.pool}
        drawn = inputs.sampler.draw(hands, held.space, held.free, **how)
        add_seconds(self.result.seconds, {"diffuser": time.perf_counter() - start})
        return drawn

    def _one_each(self, space: np.ndarray) -> None:
        """One grasp of each row with its space, by the optimiser or as the network draws it."""
        able, view = np.flatnonzero(space >= 0), self.inputs.view
        if not len(able):
            return
        context = self._context(able, space[able], 1, self.seed)
        if self.params.method == "diffuser":
            drawn = self._drawn(able, context.held, 1, 0)
            found = upload_predicted(view.hand, context.object, context.held, view.records, *drawn)
            grasps = TouchingGrasps(*drawn, *fetch([found.hand_point, found.object_point]))
        else:
            grasps = self._optimised(able, context.held)
        meter = Meter(context.device)
        table = run_stage("filter", touching_sets(grasps, context), self.pipeline, context, meter)
        self._take(table, [meter], able, space[able], 1, 0)

    def _optimised(self, able: np.ndarray, held: HeldArrays) -> "Optimised":
        from lgrasp.sequence.optimiser.optimise import optimise  # torch

        inputs, rows, params = self.inputs, self.rows, self.params
        assert held.space is not None
        start = time.perf_counter()
        grasps = optimise(
            inputs.view.hand.model,
            inputs.spaces,
            [obj.model for obj in inputs.objects[: rows.steps + 1]],
            space=held.space,
            q=rows.posture(inputs.hand.tree)[able],
            free=held.free,
            held=rows.pose[able],
            seed=np.array([stage_seed(self.seed, rows.steps, params.method, int(i)) for i in able]),
            params=params.optimiser,
            method=params.method,
            device=inputs.device.alias,
        )
        add_seconds(self.result.seconds, {params.method: time.perf_counter() - start})
        return grasps

    def _take(
        self, grasps: GraspTable, meters: list[Meter], chosen: np.ndarray, space: np.ndarray, size: int, before: int
    ) -> None:
        """Keep grasps by candidates that continue ``chosen`` rows, ``size`` each, after ``before`` others."""
        for meter in meters:
            self.result.count(meter.counts, meter.seconds)
        row, tries, pair = grasps.index // size, self.params.tries, chosen * len(self.inputs.spaces) + space
        self.found.append(replace(grasps, index=pair[row] * tries + before + grasps.index % size))
        self.tried.append(pair)
        self.have += np.bincount(chosen[row], minlength=len(self.rows))

    def _longer(self) -> SequenceTable:
        """The sequences that are continued, by row and space; their candidates are numbered over all rows."""
        tries, spaces = self.params.tries, self.inputs.spaces
        pairs, grasps = np.unique(np.concatenate(self.tried)), join_rows(self.found)
        rows, space = np.divmod(pairs, len(spaces))
        grasps = take_rows(grasps, np.argsort(grasps.index, kind="stable"))
        place = np.searchsorted(pairs, grasps.index // tries) * tries + grasps.index % tries
        context, before = self._context(rows, space, tries, self.seed), take_rows(self.rows, rows)
        table, counts = grow((before, replace(grasps, index=place)), self.params, context)
        for number, found in counts.items():
            self.result.count({"sequence": found})
            add_counts(self.result.spaces[-1], {spaces[number].name: found})
        parent = rows[table.parent]
        return replace(table, parent=parent, candidate=parent * tries + table.candidate % tries)

    def _context(self, chosen: np.ndarray, space: np.ndarray, tries: int, seed: int) -> Context:
        """Input of the stages that continue chosen rows with opposition spaces."""
        inputs, before = self.inputs, take_rows(self.rows, chosen)
        view, step, posture = inputs.view, before.steps, before.posture(inputs.hand.tree)
        held = inputs.objects[:step], before.pose
        return Context(
            view.hand,
            inputs.objects[step],
            view.field,
            inputs.device.alias,
            seed,
            0,
            self.pipeline.bounds,
            holding=hold(view.hand, posture, before.used, *held, tries=tries, spaces=inputs.spaces, space=space),
            realised=self.pipeline.realised,
        )

    def _from_stages(self, context: Context, candidates: int) -> tuple[GraspTable, list[Meter]]:
        """Grasps of all candidates that continue the held rows; on a CPU several chunks of them at a time."""
        size = _CPU_CHUNK if context.device == "cpu" else _GPU_CHUNK
        meters = [Meter(context.device) for _ in range(0, candidates, size)]

        def run(number: int) -> GraspTable:
            first, meter = number * size, meters[number]
            return run_stages(self.pipeline, context, first, min(size, candidates - first), "filter", meter)

        return join_rows(list(self.pool.map(run, range(len(meters))))), meters


def _that_hold(
    rows: SequenceTable, columns: dict[str, np.ndarray], inputs: SequenceInputs, result: Round
) -> SequenceTable:
    holds = next(values for name, values in columns.items() if name.endswith("_holds")).astype(bool)
    for number, space in enumerate(inputs.spaces):
        own = rows.space[:, -1] == number
        if own.any():
            tried, held = int(own.sum()), int(holds[own].sum())
            result.count({"simulate": {"tried": tried, "held": held}})
            add_counts(result.spaces[-1], {space.name: {"simulated": tried, "stable": held}})
    return take_rows(replace(rows, physics=columns), np.flatnonzero(holds))

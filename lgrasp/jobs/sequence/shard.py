"""One shard of sequences: rounds until there are enough."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import zip_longest

import numpy as np

from lgrasp.engine.pipeline import Pipeline
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.duplicates import KeptRows
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.grasp.tables import join_rows, take_rows
from lgrasp.jobs.sequence.inputs import SequenceInputs
from lgrasp.jobs.sequence.round import Round, Verdicts, add_steps, run_round
from lgrasp.runtime.tally import add_counts, add_seconds, covered

_EMPTY_ROUNDS = 4  # without any row of some length, before nothing more is expected
_SPARE = 1.5  # sequences begun for each that is needed, if all go well


@dataclass
class SequenceResult(Round):
    """Sequences of a shard and how they came about: the rounds together."""

    reached: list[int] = field(default_factory=list)  # rows of 1, 2 ... objects that were found
    spans: list[tuple[float, float]] = field(default_factory=list)  # from when to when [s since 1970]
    rounds: int = 0
    duplicates: int = 0
    exhausted: bool = False

    @property
    def wall(self) -> float:
        """How long it took [s]."""
        return covered(self.spans)

    def __len__(self) -> int:
        """Whole sequences."""
        return len(self.levels[-1]) if self.levels else 0

    def add(self, found: Round) -> None:
        """Count a further round."""
        self.rounds += 1
        add_counts(self.counts, found.counts)
        add_seconds(self.seconds, found.seconds)
        add_steps(self.steps, found.steps)
        add_steps(self.spaces, found.spaces)
        self.reached = [a + b for a, b in zip_longest(self.reached, map(len, found.levels), fillvalue=0)]


def most_rounds(pipeline: Pipeline, rows: int) -> int:
    """Rounds that a shard of ``rows`` sequences may take."""
    params = pipeline.params("sequence")
    return -(-rows // params.width) * params.rounds


def make_sequences(
    pipeline: Pipeline,
    inputs: SequenceInputs,
    shard: int,
    rows: int,
    workers: int,
    *,
    progress: Callable[[int, float], None] = lambda rows, ahead: None,
    verdicts: Verdicts | None = None,
) -> SequenceResult:
    """The first ``rows`` whole sequences of a shard, near-duplicates left out, with the rows that they extend.

    Args:
        workers: threads; they do not change the rows.
        progress: called with (sequences so far, how many more the work on the running round is worth); what it raises
            ends the shard.
    """
    result = SequenceResult()
    objects, width = len(inputs.objects), pipeline.params("sequence").width
    kept = KeptRows(inputs.hand.dofs, inputs.device.alias)
    parts: list[list[SequenceTable]] = []
    start = time.time()
    while kept.count < rows and not result.exhausted:
        found, begun, ended = Round(), 0, 0
        while begun < width and kept.count < rows:
            needed, spent = rows - kept.count, found.seconds
            begun = _begun(needed, begun, ended, pipeline, inputs)
            found = run_round(
                pipeline,
                inputs,
                shard,
                result.rounds,
                workers,
                lambda share, done=kept.count, most=begun: progress(done, share * min(rows - done, most)),
                verdicts,
                begun=begun,
            )
            add_seconds(found.seconds, spent)
            if len(found.levels) == objects:
                last = take_rows(found.levels[-1], np.arange(ended, len(found.levels[-1])))
                # two sequences are near-duplicates at most where their first objects and their joints are
                pose = user_poses(last.pose[:, 0], inputs.objects[0].model.center)
                new, duplicates = kept.add(pose, last.q[:, -1], needed)
                result.duplicates += duplicates
                parts.append(_lineage(found.levels, ended + new))
                ended += len(last)
            progress(kept.count, 0.0)
        result.add(found)
        missing = len(result.reached) < objects or min(result.reached) == 0
        hopeless = result.rounds >= _EMPTY_ROUNDS and missing
        result.exhausted = kept.count < rows and (hopeless or result.rounds >= most_rounds(pipeline, rows))
    result.levels = _joined(parts)
    result.spans = [(start, time.time())]
    return result


def _begun(needed: int, begun: int, ended: int, pipeline: Pipeline, inputs: SequenceInputs) -> int:
    """With how many sequences a round is begun, of which ``begun`` gave ``ended`` whole ones, not the ``needed``: rows
    are the same, few take less time."""
    params = pipeline.params("sequence")
    if inputs.device.alias != "cpu" or not params.in_waves:  # many take hardly longer
        return params.width
    more = begun + int(_SPARE * needed * (begun + 1) / (ended + 1))
    return more if 2 * more <= params.width else params.width


def _lineage(levels: list[SequenceTable], rows: np.ndarray) -> list[SequenceTable]:
    """Some rows of the last level and those that they extend; parents are renumbered."""
    out: list[SequenceTable] = []
    for table in reversed(levels):
        taken = take_rows(table, rows)
        rows, parent = np.unique(taken.parent, return_inverse=True)
        out.append(replace(taken, parent=parent if table.steps > 1 else np.full(len(parent), -1)))
    return out[::-1]


def _joined(parts: list[list[SequenceTable]]) -> list[SequenceTable]:
    """Rows of several rounds by number of objects; a parent is a row of the level before."""
    if not parts:
        return []
    joined = []
    for step in range(len(parts[0])):
        shifts = np.cumsum([0, *(len(levels[step - 1]) for levels in parts)]) if step else [0] * len(parts)
        parents = zip(parts, shifts, strict=False)
        joined.append(join_rows([replace(p[step], parent=p[step].parent + shift) for p, shift in parents]))
    return joined

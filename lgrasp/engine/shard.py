"""One shard: a pure function of (pipeline, hand, object, shard rows, shard index)."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from lgrasp.engine.bank import Account, Bank, ShardResult
from lgrasp.engine.batch import PASS_BLOCK, BatchResult, block_size, run_batch
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import CancelledError
from lgrasp.engine.graphs import GraphCache
from lgrasp.engine.inputs import Inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.duplicates import KeptRows
from lgrasp.grasp.row_order import RowOrder
from lgrasp.grasp.tables import GraspTable, join_rows, no_grasps, take_rows
from lgrasp.runtime.ordered import in_order
from lgrasp.runtime.tally import add_counts, add_seconds
from lgrasp.runtime.turn import waited
from lgrasp.stages.context import Context

_LEAST_EFFORT = 65_536  # candidates that any shard may try
_LEAST_PLACED = 65_536  # candidates of which one must be placed where poses are steered, else a shard ends
_LEAST_TURNS = 64  # of each pose that is asked for, of which one must be placed
_EFFORT_STEP = 1024  # candidates: what a shard may try is a multiple of it
_CPU_LARGEST = 1024  # candidates of a batch
_SLOW_LARGEST = 512  # the same where a candidate takes long (block_size)
_PHYSICS_BATCH = 64  # candidates, when their grasps are simulated on the CPU, which takes long
_GPU_SMALLEST, _GPU_LARGEST = 2_048, 524_288  # candidates of a batch
_GROUP_BYTES = 4_000  # of device memory for a candidate and a group of the hand, generously
_CONTACT_BYTES = 64  # the same for a contact of its domain
_SET_BYTES = 32  # the same for a set of contacts
STREAM = 2**31 - 2**20  # candidates of a shard have 31-bit numbers


@dataclass(frozen=True)
class Execution:
    """How a job runs; none of this changes its rows."""

    workers: int = 1
    batch: int = 0  # candidates per batch; 0: by device
    rate: float = 1.0  # rows expected per candidate, until there are some: sizes the first batch on a GPU
    graphs: GraphCache | None = None  # replays batches; for one worker a shard


def flat_statistics(counts: dict[str, dict[str, int]], seconds: Mapping[str, float]) -> dict[str, int | float]:
    """Survivors and seconds per stage as the statistics of a shard: STAGE_NAME and seconds_STAGE."""
    flat: dict[str, int | float] = {}
    for stage, found in counts.items():
        flat |= {f"{stage}_{name.replace(' ', '_')}": value for name, value in found.items()}
    return flat | {f"seconds_{stage}": value for stage, value in seconds.items()}


def _most_candidates(device: str, groups: int, pipeline: Pipeline) -> int:
    """Candidates that a batch may have on a GPU: it takes at most a quarter of the memory that is free now."""
    free = wp.get_device(device).free_memory
    keep = pipeline.params("domain").keep if "domain" in pipeline.order else 1
    tables = _CONTACT_BYTES * keep + _SET_BYTES * pipeline.params("search").per_pose
    return int(min(max(free / 4 / (max(_GROUP_BYTES, tables) * groups), _GPU_SMALLEST), _GPU_LARGEST))


def _batch_size(
    device: str,
    missing: int,
    rate: float,
    running: int,
    most: int = _GPU_LARGEST,
    *,
    block: int = PASS_BLOCK,
    share: int = 1,
) -> int:
    """Candidates of a batch when ``running`` others are worked on; 0 when those should give the missing rows.

    On a GPU as many as should give them, up to ``most``: half as many take more than half the time.

    Args:
        rate: rows expected per candidate.
        block: candidates of a block (:func:`block_size`).
        share: workers among which a CPU divides what is missing; 0: the rate is a guess, which must leave none idle.
    """
    if running >= missing / rate > 0 and (share or device != "cpu"):
        return 0
    if device == "cpu":
        # large ones are faster; shares of what is missing keep the workers busy to the end and little in vain
        needed = (missing / rate - running) / share if share else 0
        return int(min(max(needed, block), _SLOW_LARGEST if block == PASS_BLOCK else _CPU_LARGEST))
    needed = 1.05 * missing / rate + 256 - running
    return int(min(max(needed, _GPU_SMALLEST), most))


def shard_effort(pipeline: Pipeline, rows: int) -> int:
    """Candidates that a shard of ``rows`` rows tries before it may give up."""
    steps = -(-max(_LEAST_EFFORT, rows * pipeline.effort) // _EFFORT_STEP)
    return min(steps * _EFFORT_STEP, STREAM)


def gave_up(pipeline: Pipeline, rows: int, found: int, tried: int) -> bool:
    """Whether a shard that has only ``found`` of its rows ends after some candidates.

    Beyond its effort it goes on while all that it may try promises half of the rows at least.
    """
    most = _most_effort(pipeline, rows)
    return tried >= most or (tried >= shard_effort(pipeline, rows) and 2 * found * most < rows * tried)


def _most_effort(pipeline: Pipeline, rows: int) -> int:
    """Candidates that a shard of ``rows`` rows may try."""
    return min(pipeline.patience * shard_effort(pipeline, rows), STREAM)


def shard_context(pipeline: Pipeline, inputs: Inputs, shard: int) -> Context:
    """The context of the stages of a pipeline in a shard."""
    return Context(
        inputs.hand,
        inputs.object,
        inputs.field,
        inputs.device.alias,
        pipeline.seed,
        shard,
        bounds=pipeline.bounds,
        scene=inputs.scene,
        steer=inputs.steer,
        policy=inputs.policy(pipeline.params("place").policy),
        realised=pipeline.realised,
        kept=inputs.kept,
    )


def make_shard(
    pipeline: Pipeline,
    inputs: Inputs,
    shard: int,
    rows: int,
    execution: Execution,
    *,
    bank_cache: Cache | None = None,
    banked: bool = True,
    resume: bool = True,
    progress: Callable[[int, ShardResult], None] | None = None,
) -> ShardResult:
    """The first ``rows`` grasps of a shard's candidate stream, near-duplicates left out, shuffled.

    The rows of the last block of candidates that is needed (:func:`block_size`) are drawn from all that it gives.

    Args:
        bank_cache: where the shard's bank is.
        banked: keep it when the shard is done, too, and not only when it is cancelled.
        resume: continue from the bank of a shard that was done, too, and not only of one that was cancelled; counts and
            seconds are then those of all runs together.
        progress: called with (rows so far, running result) after each batch; what it raises ends the shard.

    Raises:
        CancelledError: ``progress`` did; what was found is in the bank.
    """
    device = inputs.device.alias
    context = shard_context(pipeline, inputs, shard)
    bank = Bank(bank_cache, pipeline, inputs.keys, shard, device) if bank_cache else None
    graphs = execution.graphs
    block = block_size(pipeline)
    turn = graphs.turn if graphs else nullcontext()
    found = _Rows(inputs, RowOrder(pipeline.seed, shard, block), rows, turn)
    account = bank.load(rows, whole=resume) if bank else None
    if account:
        found.restore(account)
    result = found.result
    start = time.time()
    fixed = execution.batch or (_PHYSICS_BATCH if context.scene and device == "cpu" else 0)  # 0: as many as seem best
    most = _GPU_LARGEST if device == "cpu" else _most_candidates(device, inputs.hand.model.groups, pipeline)

    def size(running: int) -> int:
        # going by those so far
        rate, missing = found.count / result.candidates if found.count else execution.rate, rows - found.count
        share = execution.workers if found.count else 0
        wanted = fixed or _batch_size(device, missing, rate, running, most, block=block, share=share)
        if graphs and not fixed and wanted:
            wanted = graphs.size(wanted)
        return -(-wanted // block) * block

    def run(part: tuple[int, int]) -> BatchResult:
        before = waited()
        with turn:
            try:
                found = run_batch(pipeline, context, *part, graphs.run if graphs else None)
            finally:
                if graphs:
                    graphs.done()
        result.waited += waited() - before
        return found

    def search(limit: int) -> None:
        def parts() -> Iterator[tuple[int, int] | None]:
            first = result.candidates
            while first < limit:
                count = min(size(first - result.candidates), limit - first)
                yield (first, count) if count else None
                first += count

        # one waits that begins at once when a worker is free
        with closing(in_order(run, parts(), execution.workers, ahead=1)) as batches:
            for (_, count), batch in batches:
                result.candidates += count
                add_counts(result.counts, batch.counts)
                add_seconds(result.seconds, batch.seconds)
                found.add(batch.grasps)
                if progress:
                    progress(found.count, result)
                if found.count >= rows:
                    break

    def search_all() -> None:
        limit = shard_effort(pipeline, rows) if found.count < rows else 0
        some = limit  # the same whatever the batches are
        if pipeline.steer.asks:
            asked = context.steered.poses
            turns = _LEAST_PLACED if asked is None else _LEAST_TURNS * len(asked)
            some = min(limit, _LEAST_PLACED, -(-turns // _EFFORT_STEP) * _EFFORT_STEP)
        search(some)
        if found.count >= rows or not result.counts["place"]["kept"]:
            return
        search(limit)
        most = _most_effort(pipeline, rows)
        while found.count < rows and limit < most:
            # asked at the same places after an interruption
            if result.candidates <= limit and gave_up(pipeline, rows, found.count, limit):
                return
            limit = min(2 * limit, most)
            search(limit)

    try:
        search_all()
    except CancelledError:
        if bank and result.candidates:
            result.spans.append((start, time.time()))
            bank.store(found.account(interrupted=True))
        raise
    finally:
        with turn:  # memory of the device is not freed while another thread captures a graph
            found.close()
            context.close()
    result.grasps = found.shuffled()
    result.spans.append((start, time.time()))
    result.exhausted = found.count < rows
    if bank and banked:
        bank.store(found.account())
    elif bank and account:
        bank.discard()
    return result


class _Rows:
    """Rows of a shard as they come in: near-duplicates are left out, rows beyond those asked are set aside."""

    def __init__(self, inputs: Inputs, order: RowOrder, rows: int, turn: AbstractContextManager[Any]) -> None:
        self.result = ShardResult(no_grasps())
        with turn:
            self._kept = KeptRows(inputs.hand.model.dofs, inputs.device.alias)
        self._center = inputs.object.model.center
        self._order = order
        self._rows = rows
        self._turn = turn  # held while the device is used
        self._parts: list[tuple[GraspTable, np.ndarray]] = []  # rows of tables, copied at the end
        self._aside: tuple[GraspTable, np.ndarray | slice] | None = None

    @property
    def count(self) -> int:
        return self._kept.count

    def close(self) -> None:
        """Free what is on the device; nothing is added from now on."""
        self._kept.close()

    def add(self, grasps: GraspTable) -> None:
        """Add the new ones of further rows, up to the number requested."""
        if self.count >= self._rows:
            self._aside = grasps, slice(None)
            return
        order = self._order.by_blocks(grasps)
        # near-duplicates are defined on poses as they are written
        pose = user_poses(grasps.pose.take(order, axis=0), self._center)
        with self._turn:
            new, duplicates = self._kept.add(pose, grasps.q.take(order, axis=0), self._rows - self.count)
        self.result.duplicates += duplicates
        self._parts.append((grasps, order[new]))
        self._aside = grasps, order[len(new) + duplicates :]

    def shuffled(self) -> GraspTable:
        """The rows that are kept, in the order in which they are written."""
        index, slot = (
            np.concatenate([getattr(t, name)[rows] for t, rows in self._parts]) for name in ("index", "slot")
        )
        order = self._order.shuffled(index, slot)
        if len(self._parts) == 1:
            table, rows = self._parts[0]
            return take_rows(table, rows[order])
        return take_rows(join_rows([take_rows(table, rows) for table, rows in self._parts]), order)

    def restore(self, account: Account) -> None:
        """Start from the state of an earlier run."""
        table, own = account.found.grasps, np.arange(account.kept)
        self._kept.restore(user_poses(table.pose[own], self._center), table.q[own])
        self._parts.append((table, own))
        self.result = replace(account.found, grasps=no_grasps())
        self.add(take_rows(table, slice(account.kept, None)))
        self.result.resumed = account.kept

    def account(self, *, interrupted: bool = False) -> Account:
        """How far the shard has come."""
        own = self.shuffled() if interrupted else self.result.grasps
        table = join_rows([own, take_rows(*self._aside)] if self._aside else [own])
        return Account(replace(self.result, grasps=table), self.count, interrupted)

"""One shard: a pure function of (pipeline, hand, object, shard rows, shard index)."""

import time
from collections import deque
from collections.abc import Callable, Generator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, nullcontext
from dataclasses import dataclass, field

import warp as wp

from lgrasp.engine.bank import BANK_CANDIDATES, Bank
from lgrasp.engine.batch import BatchResult, finish_batch, run_batch
from lgrasp.engine.cache import Cache
from lgrasp.engine.graphs import Recorder
from lgrasp.engine.inputs import Inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.duplicates import KeptRows
from lgrasp.grasp.tables import GraspTable, join_grasps, take_grasps
from lgrasp.stages.context import Context

_LEAST_EFFORT = 65_536
_CPU_BATCH, _PHYSICS_BATCH = 256, 32  # rows of a simulation are dear
_GPU_LEAST, _GPU_WHOLE, _GPU_MOST = 2_048, 16_384, 65_536
_GROUP_BYTES = 4_000  # of device memory for a candidate and a group of the hand, generously
_STREAM = 2**31 - 2**20  # candidates of a shard have 31-bit numbers


@dataclass(frozen=True)
class Execution:
    """How a job runs; none of this changes its rows."""

    workers: int = 1
    batch: int = 0  # candidates per batch; 0: by device
    rate: float = 1.0  # rows expected per candidate, until there are some: sizes the first batch on a GPU
    recorder: Recorder | None = None  # replays batches; for one worker, without a bank, one pass


@dataclass
class ShardResult:
    """Rows of a shard and how they came about."""

    grasps: GraspTable
    counts: dict[str, dict[str, int]] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)  # thread-seconds per stage
    wall: float = 0.0  # placement through filter [s]
    candidates: int = 0
    duplicates: int = 0
    exhausted: bool = False  # the effort bound was reached before the rows were


def add_counts(total: dict[str, dict[str, int]], more: dict[str, dict[str, int]]) -> None:
    """Add survivors per stage to a running total."""
    for stage, counts in more.items():
        into = total.setdefault(stage, {})
        for name, value in counts.items():
            into[name] = into.get(name, 0) + value


def add_seconds(total: dict[str, float], more: Mapping[str, float]) -> None:
    """Add seconds per stage to a running total."""
    for stage, value in more.items():
        total[stage] = total.get(stage, 0.0) + value


def flat_statistics(counts: dict[str, dict[str, int]], seconds: Mapping[str, float]) -> dict[str, int | float]:
    """Survivors and seconds per stage as the statistics of a shard: STAGE_NAME and seconds_STAGE."""
    flat: dict[str, int | float] = {}
    for stage, found in counts.items():
        flat |= {f"{stage}_{name.replace(' ', '_')}": value for name, value in found.items()}
    return flat | {f"seconds_{stage}": value for stage, value in seconds.items()}


def _batches(
    run: Callable[[int, int], BatchResult], workers: int, limit: int, size: Callable[[int], int]
) -> Generator[tuple[int, BatchResult]]:
    """Results of consecutive batches, in order; ``workers`` of them are worked on at a time.

    Closing the generator (or an error in a batch) drops the batches not begun and waits for those that were.

    Args:
        run: makes the batch of candidates ``first .. first + count - 1`` from (first, count).
        limit: candidates there may be.
        size: candidates of the next batch, given how many are being worked on; 0: those should do.
    """
    first = 0
    with ThreadPoolExecutor(workers) as pool:
        waiting: deque[tuple[int, Future[BatchResult]]] = deque()
        try:
            while True:
                # one more than there are workers: it begins at once when a worker is free
                while len(waiting) <= workers and first < limit:
                    count = min(size(sum(n for n, _ in waiting)), limit - first)
                    if count == 0:
                        break
                    waiting.append((count, pool.submit(run, first, count)))
                    first += count
                if not waiting:
                    return
                count, future = waiting.popleft()
                yield count, future.result()
        finally:
            for _, future in waiting:
                future.cancel()


def _most_candidates(device: str, groups: int) -> int:
    """Candidates that a batch may have on a GPU: two batches take at most half of the free memory."""
    free = wp.get_device(device).free_memory
    return int(min(max(free / 4 / (_GROUP_BYTES * groups), _GPU_LEAST), _GPU_MOST))


def _batch_size(device: str, missing: int, rate: float, running: int, most: int = _GPU_MOST) -> int:
    """Candidates of a batch when ``running`` others are worked on.

    On a GPU as many as should give the missing rows, up to ``most``, and none when those running should. Many are cut
    in two, so that the rows of one part are taken over while the other is worked on.
    """
    if device == "cpu":
        return _CPU_BATCH
    if running >= missing / rate > 0:
        return 0
    needed = 1.05 * missing / rate + 256 - running
    if not running and needed > _GPU_WHOLE:
        needed /= 2
    return int(min(max(needed, _GPU_LEAST), most))


def shard_effort(pipeline: Pipeline, rows: int) -> int:
    """Candidates that a shard of ``rows`` rows may try: whole bank entries."""
    entries = -(-max(_LEAST_EFFORT, rows * pipeline.effort) // BANK_CANDIDATES)
    return min(entries * BANK_CANDIDATES, _STREAM)


def shard_context(pipeline: Pipeline, inputs: Inputs, shard: int) -> Context:
    """What the stages of a pipeline are given in a shard."""
    return Context(
        inputs.hand,
        inputs.object,
        inputs.field,
        inputs.device.alias,
        pipeline.seed,
        shard,
        bounds=pipeline.bounds,
        scene=inputs.scene,
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
    progress: Callable[[int, ShardResult], None] | None = None,
) -> ShardResult:
    """The first ``rows`` grasps of a shard's candidate stream, near-duplicates left out.

    Args:
        bank_cache: keep and use candidate banks there.
        progress: called with (rows so far, running result) after each batch; what it raises ends the shard.
    """
    device = inputs.device.alias
    context = shard_context(pipeline, inputs, shard)
    bank = Bank(bank_cache, pipeline, inputs.keys, shard, device) if bank_cache else None
    limit = shard_effort(pipeline, rows)
    result: ShardResult | None = None
    parts: list[GraspTable] = []
    kept = KeptRows(inputs.hand.model.dofs, device)
    start = time.perf_counter()
    recorder, fixed = execution.recorder, execution.batch
    if bank is not None or pipeline.params("search").passes > 1:
        # later passes go over the poses of one batch, so its size decides the order of the rows
        fixed = BANK_CANDIDATES
    elif not fixed and context.scene and device == "cpu":
        fixed = _PHYSICS_BATCH
    most = _GPU_MOST if device == "cpu" else _most_candidates(device, inputs.hand.model.groups)

    def size(running: int) -> int:
        # going by those so far
        rate = kept.count / result.candidates if result and kept.count else execution.rate
        wanted = fixed or _batch_size(device, rows - kept.count, rate, running, most)
        return recorder.size(wanted) if recorder and not fixed and wanted else wanted

    def run(first: int, count: int) -> BatchResult:
        if recorder is None:
            return run_batch(pipeline, context, first, count, bank)
        return finish_batch(pipeline, context, *recorder.run(context, first, count))

    with closing(_batches(run, execution.workers, limit, size)) as batches:
        for count, batch in batches:
            if result is None:
                result = ShardResult(batch.grasps)
            result.candidates += count
            add_counts(result.counts, batch.counts)
            add_seconds(result.seconds, batch.seconds)
            # near-duplicates are defined on poses as they are written
            pose = user_poses(batch.grasps.pose, inputs.object.model.center)
            with recorder.recording if recorder else nullcontext():
                new, duplicates = kept.add(pose, batch.grasps.q, rows - kept.count)
            result.duplicates += duplicates
            parts.append(take_grasps(batch.grasps, new))
            if progress:
                progress(kept.count, result)
            if kept.count >= rows:
                break
    assert result is not None
    result.grasps = join_grasps(parts)
    result.wall = time.perf_counter() - start
    result.exhausted = kept.count < rows
    return result

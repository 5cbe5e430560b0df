"""Batches of one size recorded as a graph: what is launched before a batch's size is known is launched as one."""

import threading
from dataclasses import dataclass, replace

import warp as wp

from lgrasp.engine.batch import run_stages
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.tables import ContactSets
from lgrasp.runtime.meter import Meter
from lgrasp.seeding import stage_seed
from lgrasp.stages.context import Context

_WORTH = 3  # times that a size has come before it is recorded, which takes as long as several batches
_KEPT = 2  # recordings: each holds the tables of a batch
_CLOSE = (0.99, 1.03)  # of the candidates wanted: sizes that serve as well


@dataclass(frozen=True)
class _Recording:
    graph: wp.Graph
    first: wp.array  # (1,) i32
    seeds: dict[tuple[str, int], wp.array]
    meter: Meter
    sets: ContactSets


class Recorder:
    """Place through search of one pipeline, hand and object, for one thread.

    A size that comes again and again is recorded; from then on it is replayed, with the seeds of the shard and the
    first candidate of the batch put where the recording reads them. The tables of a replay are overwritten by the next.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self.recording = threading.Lock()
        """Held while a batch is recorded: whoever else uses the device must hold it too."""
        self._times: dict[int, int] = {}  # by size, the latest last
        self._recordings: dict[int, _Recording] = {}

    def size(self, wanted: int) -> int:
        """Candidates for a batch that should have about ``wanted``: a size that was there before, if one is close."""
        low, high = (wanted * share for share in _CLOSE)
        return next((n for n in reversed(self._times) if low <= n <= high), wanted)

    def run(self, context: Context, first: int, count: int) -> tuple[ContactSets, Meter]:
        """The sets of candidates ``first .. first + count - 1``, and their counts and seconds."""
        self._times[count] = self._times.pop(count, 0) + 1
        if self._times[count] <= _WORTH:
            meter = Meter(context.device)
            return run_stages(self._pipeline, context, first, count, "search", meter), meter
        if count not in self._recordings:
            while len(self._recordings) >= _KEPT:
                del self._recordings[min(self._recordings, key=list(self._times).index)]
            self._recordings[count] = self._record(context, count)
        recording = self._recordings[count]
        recording.first.fill_(first)
        for (stage, salt), seed in recording.seeds.items():
            seed.fill_(stage_seed(context.base_seed, context.shard, stage, salt))
        wp.capture_launch(recording.graph)
        return recording.sets, recording.meter.again()

    def _record(self, context: Context, count: int) -> _Recording:
        device = context.device
        own = replace(context, seeds={}, holding=context.held)
        for stage in self._pipeline.order[: self._pipeline.order.index("search") + 1]:
            own.seed(stage)
        first = wp.zeros(1, dtype=wp.int32, device=device)
        meter = Meter(device)
        with self.recording, wp.ScopedCapture(device=device) as capture:
            sets = run_stages(self._pipeline, own, first, count, "search", meter)
        assert capture.graph is not None
        return _Recording(capture.graph, first, own.seeds, meter, sets)

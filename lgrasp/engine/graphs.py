"""CUDA graphs of batches: launches before the number of survivors is known are combined into one."""

import threading
from dataclasses import dataclass

import warp as wp

from lgrasp.engine.batch import run_stages
from lgrasp.engine.pipeline import Pipeline
from lgrasp.grasp.tables import ContactSets, trim_sets
from lgrasp.runtime.tally import Meter
from lgrasp.runtime.turn import Turn, others_turn
from lgrasp.seeding import stage_seed
from lgrasp.stages.context import Context

_MOST_GRAPHS = 2
"""Graphs kept at a time: each holds the tables of a batch, and one is replayed while those of another are read."""
_SPOILT = "graph capture failed"
"""Of errors of Warp: memory that another thread frees just as a capture begins spoils it."""
_SAME_SIZE = (0.98, 1.05)
"""Share of the candidates wanted that a size may be and serve as well."""


@dataclass(frozen=True, eq=False)
class _CapturedGraph:
    count: int
    graph: wp.Graph
    first: wp.array  # (1,) i32
    context: Context  # the graph reads its arrays: they must stay
    meter: Meter
    sets: ContactSets


class GraphCache:
    """Place through search of one pipeline, hand and object.

    A size that comes again is captured; from then on it is replayed, with the seeds of the shard and the
    first candidate of the batch put where the graph reads them. The tables of a replay are those of the thread that
    asked, until it asks again or calls :meth:`done`.
    """

    def __init__(self, pipeline: Pipeline) -> None:
        self._pipeline = pipeline
        self.turn = Turn()
        """Held by the thread that runs a batch; whoever else uses the device must hold it too."""
        self._sizes: list[int] = []  # that there were, the latest last
        self._graphs: list[_CapturedGraph] = []
        self._held: dict[int, _CapturedGraph] = {}  # by thread
        self._free = threading.Semaphore(_MOST_GRAPHS)

    def size(self, wanted: int) -> int:
        """Candidates for a batch that should have about ``wanted``: a size that was there before, if one is close."""
        low, high = (wanted * share for share in _SAME_SIZE)
        return next((n for n in reversed(self._sizes) if low <= n <= high), wanted)

    def run(self, context: Context, first: int, count: int) -> tuple[ContactSets, Meter]:
        """The sets of candidates ``first .. first + count - 1``, and their counts and seconds."""
        self.done()
        captured = self._take(context, count) if count in self._sizes else None
        self._sizes = [*(n for n in self._sizes if n != count), count]
        if captured is None:
            meter = Meter(context.device)
            return run_stages(self._pipeline, context, first, count, "search", meter), meter
        captured.first.fill_(first)
        for (stage, salt), seed in captured.context.seeds.items():
            seed.fill_(stage_seed(context.base_seed, context.shard, stage, salt))
        wp.capture_launch(captured.graph)
        meter, (used,) = captured.meter.again([captured.sets.rows])
        return trim_sets(captured.sets, int(used[0])), meter

    def done(self) -> None:
        """The calling thread, whose turn it is, has launched all that reads the tables of its last batch."""
        if self._held.pop(threading.get_ident(), None):
            self._free.release()

    def _take(self, context: Context, count: int) -> _CapturedGraph | None:
        """A graph of this size, from now on the thread's own; None if it could not be captured."""
        if not self._free.acquire(blocking=False):
            with others_turn():
                self._free.acquire()
        try:
            captured = self._idle(context, count)
        except BaseException as error:
            self._free.release()
            if isinstance(error, RuntimeError) and _SPOILT in str(error):
                return None
            raise
        self._held[threading.get_ident()] = captured
        return captured

    def _idle(self, context: Context, count: int) -> _CapturedGraph:
        """A graph of this size that no thread has, captured if there is none."""
        idle = [graph for graph in self._graphs if graph not in self._held.values()]
        found = next((graph for graph in idle if graph.count == count), None)
        if found is None:
            if len(self._graphs) == _MOST_GRAPHS:
                self._graphs.remove(min(idle, key=lambda graph: self._sizes.index(graph.count)))
            found = self._capture(context, count)
            self._graphs.append(found)
        return found

    def _capture(self, context: Context, count: int) -> _CapturedGraph:
        device = context.device
        own = context.changed(seeds={})
        for stage in self._pipeline.order[: self._pipeline.order.index("search") + 1]:
            own.seed(stage)
        first = wp.zeros(1, dtype=wp.int32, device=device)
        meter = Meter(device)
        with wp.ScopedCapture(device=device) as capture:
            sets = run_stages(self._pipeline, own, first, count, "search", meter)
        assert capture.graph is not None
        return _CapturedGraph(count, capture.graph, first, own, meter, sets)

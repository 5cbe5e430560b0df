"""Copies of shards with more quality metrics."""

from collections.abc import Sequence
from contextlib import ExitStack
from typing import Any, ClassVar

from pydantic import PrivateAttr

from lgrasp.dataset.extend import extend_shard
from lgrasp.dataset.metrics import METRICS, TASK_ROWS, is_extended, measure_shard, process_map
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Made, Part, PartProgress
from lgrasp.engine.run import JobOutcome
from lgrasp.engine.shard_job import ShardJob
from lgrasp.jobs.requests.shards import MetricsRequest
from lgrasp.runtime.cores import threads


class MetricsJob(MetricsRequest, ShardJob):
    """Metrics that are computed from the shards alone, added to copies of them."""

    command: ClassVar[str] = "dataset metrics"

    _open: ExitStack = PrivateAttr(default_factory=ExitStack)
    _each: Any = PrivateAttr(None)

    def key(self) -> str:
        return content_key("metrics", 1, names=list(self.add), settings=list(self.settings))

    def present(self, parts: Sequence[Part]) -> dict[int, int]:
        """A copy tells by its rows and metrics whether it may stay; other bounds are not seen in it."""
        if self.settings:
            return {}
        return {p.number: p.rows for p in parts if p.source and is_extended(p.file, p.source, self.add)}

    def make(self, part: Part, progress: PartProgress) -> Made:
        assert part.source is not None
        workers = threads(self.workers)
        if self._each is None:
            self._each = self._open.enter_context(process_map(workers))
        columns = measure_shard(part.source, self.settings, self._each, 4 * workers * TASK_ROWS, progress)
        return Made(part.rows, {name: columns[name] for name in self.add})

    def write(self, part: Part, contents: Any) -> None:
        assert part.source is not None
        extend_shard(part.source, part.file, contents, METRICS)

    def close(self) -> None:
        self._open.close()

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``rows`` made, ``rows_per_s``, ``metrics``."""
        seconds = outcome.seconds["parts"]
        return {
            "rows": outcome.made,
            "rows_per_s": outcome.made / seconds if seconds else 0.0,
            "metrics": list(self.add),
        }

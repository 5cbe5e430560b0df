"""Copies of shards with more metrics."""

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp.dataset.metrics import MEASURED, METRICS, TASK_ROWS, measure_shard, measured_in, measured_with, process_map
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.report.write import read_dataset
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.shard_job import ShardJob
from lgrasp.errors import OutputError, ShardError
from lgrasp.grasp.bounds import GraspBounds, stages_told, stored_bounds
from lgrasp.grasp.rows import METRIC_UNITS
from lgrasp.hold.params import HOLD_VERSION, HoldTest
from lgrasp.jobs.difference import text_difference
from lgrasp.jobs.requests.shards import MetricsRequest
from lgrasp.jobs.shard_inputs import arrays_of_shard, object_of_shard
from lgrasp.notices import notice
from lgrasp.object.arrays import upload_object
from lgrasp.runtime.cores import threads
from lgrasp.runtime.processes import none_killed

HOLD = "hold"


class MetricsJob(MetricsRequest, ShardJob):
    """More metrics of the rows of shards, added to copies of them."""

    command: ClassVar[str] = "dataset metrics"
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.hold.",)

    _open: ExitStack = PrivateAttr(default_factory=ExitStack)
    _each: Any = PrivateAttr(None)
    _copies: dict[int, Path] = PrivateAttr(default_factory=dict)

    def key(self) -> str:
        return content_key("metrics", 1, names=list(self.add), settings=list(self.settings))

    def check_source(self, reader: ShardReader) -> None:
        if HOLD not in self.add:
            return
        names = reader.object_ids
        if len(names) != 1 or reader.columns["object_index"][0][1] != 1:
            raise ShardError(f"{reader.path}: rows of several objects cannot be tried; one object a shard is accepted")
        if not len(reader.object(names[0]).faces):
            raise ShardError(f"{reader.path}: object '{names[0]}' is a point cloud; the hold test needs a mesh")

    def present(self, parts: Sequence[Part]) -> dict[int, int]:
        """A copy tells with which numbers it was measured; metrics that it lacks are added to it.

        Raises:
            OutputError: a copy was measured with other numbers, or is of other rows.
        """
        present = {}
        for part in parts:
            assert part.source is not None
            there = measured_in(part.file, part.source)
            if there is None:
                continue
            with ShardReader(part.source) as reader:
                asked = self._measured(*self._numbers_of(reader))
            for name, how in _differences(there, asked):
                raise OutputError(
                    f"{part.file} has {name} measured with other numbers ({how}); choose another --out, or "
                    "--overwrite to replace it"
                )
            self._copies[part.number] = part.file
            if asked.keys() <= there.keys():
                present[part.number] = part.rows
        return present

    def extended(self, part: Part) -> Path:
        return self._copies.get(part.number) or super().extended(part)

    def load(self, events: Events, missing: bool) -> None:
        if HOLD in self.add:
            import lgrasp.hold.stored  # noqa: F401  now, so that its kernels are compiled before the clock starts

    def make(self, part: Part, progress: PartProgress) -> Made:
        assert part.source is not None
        with ShardReader(part.source) as reader:
            (bounds, test), key = self._numbers_of(reader), self.key_of(reader)
            asked, there = self._measured(bounds, test), _measured_by_stage(reader) | measured_with(reader)
        for name, how in _differences(there, asked):
            notice(f"{name} of the shards was measured with other numbers ({how}); the copies have the new values")
        told = {name + MEASURED: text for name, text in asked.items()}
        workers, others = threads(self.workers), [name for name in self.add if name != HOLD]
        kinds, columns = (HOLD in self.add) + bool(others), {}
        if others:
            if self._each is None:
                self._each = self._open.enter_context(process_map(workers))
            block = 4 * workers * TASK_ROWS
            with none_killed("computes metrics"):
                found = measure_shard(
                    part.source, bounds.friction, self._each, block, lambda done: progress(done // kinds)
                )
            columns |= {name: found[name] for name in others}
        if HOLD in self.add:
            first = part.rows * (kinds - 1)
            columns |= self._tried(part, test, workers, lambda done: progress((first + done) // kinds))
        return Made(part.rows, (key, {"metrics": columns, "units": METRIC_UNITS | METRICS, "statistics": told}))

    def close(self) -> None:
        self._open.close()

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``rows`` made, ``rows_per_s``, ``metrics``; ``sets``: of all rows of a hand with an object ``coverage`` and
        ``diversity``, as in the report of a data set."""
        seconds = outcome.seconds["parts"]
        return {
            "rows": outcome.made,
            "rows_per_s": outcome.made / seconds if seconds else 0.0,
            "metrics": self._names(),
            "sets": _sets(outcome.paths),
        }

    def _numbers_of(self, reader: ShardReader) -> tuple[GraspBounds, HoldTest]:
        """What the rows of a shard are measured with."""
        return self.numbers(stored_bounds(reader.header.config, reader.path))

    def _measured(self, bounds: GraspBounds, test: HoldTest) -> dict[str, str]:
        """With which numbers (JSON) each metric that is added is measured."""
        numbers = {HOLD: test.model_dump(mode="json") | {"version": HOLD_VERSION}}
        return {name: json.dumps(numbers.get(name, {"friction": bounds.friction}), sort_keys=True) for name in self.add}

    def _names(self) -> list[str]:
        """All metrics that are added."""
        if HOLD not in self.add:
            return list(self.add)
        from lgrasp.hold.run import METRICS as TRIED  # slow to load

        return [name for asked in self.add for name in (TRIED if asked == HOLD else (asked,))]

    def _tried(
        self, part: Part, test: HoldTest, workers: int, progress: Callable[[int], None]
    ) -> dict[str, np.ndarray]:
        """Metrics of the hold test."""
        from lgrasp.hold.stored import try_rows

        assert part.source is not None
        shard, device = read_shard(part.source), self.device_used
        hand = arrays_of_shard(self.cache, shard.hand, shard.header.config, device)
        obj = upload_object(object_of_shard(self.cache, shard.objects[0]), device.alias)
        return try_rows(hand, obj, test, shard.grasps, shard.header.seed, workers=workers, progress=progress)


def _measured_by_stage(reader: ShardReader) -> dict[str, str]:
    """The numbers (JSON) with which the pipeline of a shard tried its rows, if it did."""
    tried = stages_told(reader.header.config, HOLD)
    return {HOLD: json.dumps(tried[0], sort_keys=True)} if tried else {}


def _differences(there: Mapping[str, str], asked: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """What was measured and is asked with other numbers (JSON), and which."""
    for name in sorted(asked.keys() & there.keys()):
        if how := text_difference(there[name], asked[name]):
            yield name, how


def _sets(paths: Sequence[Path]) -> list[dict[str, Any]]:
    """What the rows of each hand with each object (or set of them) show together."""
    if not paths:
        return []
    numbers, _ = read_dataset(list(paths), near=False)
    same = ("objects", "rows", "coverage", "diversity")
    return [
        {"hand": hand["hand"], **{name: group[name] for name in same}}
        for hand in numbers["hands"]
        for group in hand["objects"]
    ]

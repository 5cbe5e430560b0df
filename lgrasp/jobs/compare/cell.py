"""One hand with one object: grasps, tried by the hold test, and by a simulator if one is asked for."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lgrasp.choices import ProtocolName
from lgrasp.dataset.reader import read_shard
from lgrasp.engine.events import CancelledError, Events, Part, PartProgress
from lgrasp.engine.run import Job, run
from lgrasp.files import temporary_folder
from lgrasp.grasp.records import Shard
from lgrasp.grasp.schema import MADE_FROM
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.metrics import HOLD, MetricsJob
from lgrasp.jobs.simulate import SimulateJob
from lgrasp.simulate.protocol import find_protocol


def make_cell(job: GenerateJob, protocol: ProtocolName | None, key: str, progress: PartProgress) -> Shard:
    """The grasps of a job with the metrics of the hold test, and with the verdicts of a protocol.

    Args:
        job: its folder is not used.
        key: content key that the shard is marked with.

    Raises:
        CancelledError: the job is to stop.
        LgraspError: see the jobs.
    """
    how = {"device": job.device, "workers": job.workers, "cache": job.cache}
    told = _Told(progress)
    with temporary_folder() as folder:
        _run(job.changed(out=folder / "grasps"), told)
        told.what = "hold test"
        tried = MetricsJob(shards=(folder / "grasps",), out=folder / "tried", add=(HOLD,), **how)
        (path,) = _run(tried, told)
        if protocol is not None:
            told.what, how["device"] = protocol, "cpu"
            simulated = SimulateJob(shards=(path,), protocol=find_protocol(protocol), out=folder / "simulated", **how)
            (path,) = _run(simulated, told)
        shard = read_shard(path)
    return replace(shard, statistics={**shard.statistics, MADE_FROM: key})


def _run(job: Job, events: Events) -> Sequence[Path]:
    outcome = run(job, events)
    if outcome.cancelled:
        raise CancelledError
    return outcome.paths


class _Told(Events):
    """What the part of a comparison tells of the jobs that it runs."""

    def __init__(self, progress: PartProgress) -> None:
        self._progress, self._kept = progress, 0
        self.what = ""
        """Is being done with the rows; none: they are being made."""

    def said(self, words: str) -> None:
        self._progress.events.said(words)

    def advanced(self, part: Part, done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        # the last row is told when the part is on disk: until then it may be stopped
        last = self._progress.part.rows - 1
        if not self.what:
            self._kept = min(kept, last)
        self._progress(last if self.what else min(done, last), self.what, kept=self._kept)

    def cancelled(self) -> bool:
        return self._progress.events.cancelled()

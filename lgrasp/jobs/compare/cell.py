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
    with temporary_folder() as folder:
        _run(job.changed(out=folder / "grasps"), _Told(progress, ""))
        tried = MetricsJob(shards=(folder / "grasps",), out=folder / "tried", add=(HOLD,), **how)
        (path,) = _run(tried, _Told(progress, "hold test", job.rows))
        if protocol is not None:
            how["device"] = "cpu"
            simulated = SimulateJob(shards=(path,), protocol=find_protocol(protocol), out=folder / "simulated", **how)
            (path,) = _run(simulated, _Told(progress, protocol, job.rows))
        shard = read_shard(path)
    return replace(shard, statistics={**shard.statistics, MADE_FROM: key})


def _run(job: Job, events: Events) -> Sequence[Path]:
    outcome = run(job, events)
    if outcome.cancelled:
        raise CancelledError
    return outcome.paths


class _Told(Events):
    """What the part of a comparison tells of a job that it runs.

    Args:
        what: is being done, once there are rows.
        rows: that are there; None: those made so far.
    """

    def __init__(self, progress: PartProgress, what: str, rows: int | None = None) -> None:
        self._progress, self._what, self._rows = progress, what, rows

    def said(self, words: str) -> None:
        self._progress.events.said(words)

    def advanced(self, part: Part, done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        # the last row is told when the part is on disk: until then it may be stopped
        self._progress(min(done if self._rows is None else self._rows, self._progress.part.rows - 1), self._what)

    def cancelled(self) -> bool:
        return self._progress.events.cancelled()

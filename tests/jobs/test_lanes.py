"""One command on several devices: lanes make the files of a single process; they fail, stop and end as one job does."""

import os
import signal
import time

import numpy as np
import pytest
from support.jobs import SampleJob, StopAfter

from lgrasp.dataset.reader import read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events
from lgrasp.engine.run import run
from lgrasp.errors import DeviceError, ObjectError
from lgrasp.jobs.lanes import Lanes
from lgrasp.runtime.array import Array
from lgrasp.runtime.device import resolve_devices


class FailingJob(SampleJob):
    """Cannot make its third part."""

    def make(self, part, progress):
        if part.number == 2:
            raise ObjectError("cup: broken")
        return super().make(part, progress)


class SlowJob(SampleJob):
    def make(self, part, progress):
        time.sleep(0.05)
        return super().make(part, progress)


class HalfSlowJob(SampleJob):
    """One lane's parts take longer than all that the other has to do."""

    def make(self, part, progress):
        time.sleep(part.number % 2)
        return super().make(part, progress)


class DyingJob(SampleJob):
    """Its third part is the end of the process that makes it."""

    def make(self, part, progress):
        if part.number == 2:
            os.kill(os.getpid(), signal.SIGKILL)
        return super().make(part, progress)


class Heard(Events):
    def __init__(self) -> None:
        self.parts, self.rows, self.asked, self.kept = set(), 0, 0, {}

    def started(self, parts, present):
        self.asked = sum(part.rows for part in parts)

    def advanced(self, part, done, note="", ahead=0.0, kept=0):
        self.kept[part.number] = kept

    def wrote(self, part, made):
        self.parts.add(part.number)
        self.rows += made.rows


def test_lanes_share_the_files_of_jobs(tmp_path):
    devices, cache = resolve_devices("cpu,cpu"), Cache(tmp_path / "cache")
    single = SampleJob(out=tmp_path / "single", rows=10, device="cpu")
    run(single)
    jobs = [
        SampleJob(out=tmp_path / "a", rows=10, device="cpu"),
        FailingJob(out=tmp_path / "b", rows=10, device="cpu"),
        SampleJob(out=tmp_path / "c", rows=2, device="cpu"),
        SlowJob(out=tmp_path / "d", rows=80, device="cpu"),
    ]
    run(jobs[0].changed(rows=2))
    with Lanes(devices, jobs, [Array()] * len(jobs), cache, resume=True) as lanes:
        events = Heard()
        made = lanes.outcome(0, jobs[0], events)
        assert (made.present, made.made, made.lanes) == (2, 8, 2)
        assert [part.number for part, _ in made.made_parts] == [1, 2, 3, 4]
        assert (events.parts, events.rows, events.asked) == ({1, 2, 3, 4}, 8, 10)
        assert sum(events.kept.values()) == events.kept[0] == 2
        for one, other in zip(sorted(single.out.glob("*.h5")), sorted(jobs[0].out.glob("*.h5")), strict=True):
            mine, theirs = read_shard(one), read_shard(other)
            np.testing.assert_array_equal(mine.grasps.q, theirs.grasps.q)
            assert mine.header == theirs.header
        with pytest.raises(ObjectError, match="cup: broken"):
            lanes.outcome(1, jobs[1], Events())
        assert lanes.outcome(2, jobs[2], Events()).rows == 2  # one that fails does not stop the others
        cut = lanes.outcome(3, jobs[3], StopAfter(1))
        assert cut.cancelled
    assert len(list(jobs[3].out.glob("*.h5"))) == len(cut.written) < 40
    assert not list(tmp_path.rglob("*.tmp"))


def test_a_lane_that_is_killed_fails_its_job_alone(tmp_path):
    """Not the one before, of which it has made its share, nor those after."""
    kinds = (HalfSlowJob, DyingJob, SlowJob)
    jobs = [kind(out=tmp_path / kind.__name__, rows=10, device="cpu") for kind in kinds]
    cache = Cache(tmp_path / "cache")
    with Lanes(resolve_devices("cpu,cpu"), jobs, [Array()] * 3, cache, resume=True) as lanes:
        assert lanes.outcome(0, jobs[0], Events()).rows == 10
        with pytest.raises(DeviceError, match=r"on cpu \(lane 1 of 2\) ended by signal 9; the same command"):
            lanes.outcome(1, jobs[1], Events())
        made = lanes.outcome(2, jobs[2], Events())
        assert (made.rows, made.cancelled) == (10, False)
    assert not list(tmp_path.rglob("*.tmp"))

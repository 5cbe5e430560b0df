"""A GPU's job: its shards are searched side by side and written by several processes; here the CPU replays batches."""

import multiprocessing

import numpy as np
import pytest
from support.jobs import StopAfter
from support.workers import lost_halfway

from lgrasp.dataset.validate import validate_shard
from lgrasp.engine.report import job_report
from lgrasp.engine.run import run as generate
from lgrasp.engine.run import run as run_job
from lgrasp.errors import DeviceError
from lgrasp.jobs.generate import GenerateJob

ROWS = 120
_COUNTED = ("grasps", "strict", "distinct_poses", "published_count", "force_closure", "counts", "near_duplicates")


@pytest.fixture
def side_by_side(monkeypatch):
    monkeypatch.setattr(GenerateJob, "replays", True)
    monkeypatch.setattr("lgrasp.jobs.generate.cores", lambda: 2)


@pytest.fixture(scope="module")
def plain(small_job, tmp_path_factory):
    """The same job, one shard at a time."""
    return generate(GenerateJob(**small_job | {"rows": ROWS, "out": tmp_path_factory.mktemp("plain")}))


def test_rows_and_report_are_those_of_one_at_a_time(plain, side_by_side, run, grasps, tmp_path):
    outcome = run(rows=ROWS)
    assert outcome.job.at_once() > 1
    assert outcome.job.writers() == 2
    expected = grasps(plain.job.out)
    for name, values in grasps(tmp_path / "out").items():
        np.testing.assert_array_equal(values, expected[name], err_msg=name)
    told, before = job_report(outcome), job_report(plain)
    assert {name: told[name] for name in _COUNTED} == {name: before[name] for name in _COUNTED}
    assert not multiprocessing.active_children()


def test_stopped_it_leaves_whole_shards(plain, side_by_side, job, raw_grasps, tmp_path):
    outcome = run_job(job(rows=ROWS), StopAfter(2))
    assert outcome.cancelled
    assert not multiprocessing.active_children()
    paths = sorted((tmp_path / "out").glob("*.h5"))
    assert 0 < len(paths) < 6
    assert [validate_shard(path) for path in paths] == [[]] * len(paths)
    assert raw_grasps(tmp_path / "out").items() <= raw_grasps(plain.job.out).items()


def test_a_writer_that_is_lost_ends_the_job_with_a_line(side_by_side, run, tmp_path, monkeypatch):
    monkeypatch.setattr("lgrasp.jobs.generate.write_shard", lost_halfway)
    with pytest.raises(DeviceError, match=r"a process that writes .*allegro-mug-00000\.h5 was killed"):
        run()
    assert not [*(tmp_path / "out").rglob("*.h5*")]
    assert not multiprocessing.active_children()

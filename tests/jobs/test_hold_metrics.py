"""``dataset metrics --add hold``: the hold test of grasps that are in shards already."""

from dataclasses import replace

import numpy as np
import pytest

from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events, JobOutcome
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.engine.run import run as run_job
from lgrasp.errors import ConfigError, OutputError, ShardError
from lgrasp.grasp.records import GraspRows
from lgrasp.hold.run import METRICS
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.metrics import MetricsJob

ROWS = 40


class Watch(Events):
    """Rows done, as they are told."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def advanced(self, part, done, *more) -> None:
        self.seen.append(done)


@pytest.fixture
def add(cache_root):
    """add(shards, out, **changes): the job of the hold test, and what came of it."""

    def add(shards, out, events=None, **changes) -> JobOutcome:
        given = {"add": ("hold",), "settings": ("hold.draws=2",), "device": "cpu", **changes}
        return run_job(MetricsJob(shards=(shards,), out=out, cache=Cache(cache_root, pytest.fail), **given), events)

    return add


@pytest.fixture(scope="module")
def tried(small_job, swift, tmp_path_factory):
    """Shards of grasps that stage hold tried, none left out: rows of two passes."""
    settings = ["hold.draws=2", "bounds.min_hold_probability=0", "bounds.max_unresisted_load=0.5", "search.passes=2"]
    pipeline = load_pipeline("robust-hold").with_settings(settings).model_copy(update={"field": swift.field})
    out = tmp_path_factory.mktemp("tried")
    generate(GenerateJob(**small_job | {"pipeline": pipeline, "rows": 2 * ROWS, "shard_rows": ROWS, "out": out}))
    return out


def without(rows: GraspRows) -> GraspRows:
    return replace(rows, metrics={name: values for name, values in rows.metrics.items() if name not in METRICS})


def test_they_are_those_of_the_stage(tried, add, tmp_path):
    """Whether shard by shard, by several threads, or merged."""
    merge_shards(tried, tmp_path / "all.h5")
    whole = read_shard(tmp_path / "all.h5")
    assert len(np.unique(whole.grasps.candidate >> np.uint64(32))) > 2
    write_shard(tmp_path / "bare" / "all.h5", replace(whole, grasps=without(whole.grasps)))
    watch = Watch()
    outcome = add(tmp_path / "bare", tmp_path / "out", watch, workers=2)
    assert outcome.job.report(outcome)["metrics"] == list(METRICS)
    assert watch.seen[-1] == 2 * ROWS
    assert watch.seen == sorted(watch.seen)
    assert len(watch.seen) > 1
    assert validate_shard(tmp_path / "out" / "all.h5") == []
    found = read_shard(tmp_path / "out" / "all.h5").grasps
    assert found.metric_units["hold_drift"] == "m"
    assert {0, 1} == set(found.metrics["hold_success"])
    same = np.all([found.metrics[n] == whole.grasps.metrics[n] for n in METRICS[:2]], axis=0)
    assert same.mean() > 0.9  # poses in files are rounded
    held = same & (found.metrics["hold_success"] > 0)
    drift = [rows.metrics["hold_drift"][held] for rows in (found, whole.grasps)]
    assert (np.abs(drift[0] - drift[1]) < 1e-4).mean() > 0.9


def test_with_others_and_again(tried, add, tmp_path, said):
    """Of more trials than stage hold had, which is told once."""
    watch = Watch()
    add(tried, tmp_path / "out", watch, add=("volume", "hold"), settings=())
    (line,) = said
    assert "hold of the shards was measured with other numbers (draws: 2 there, 32 requested)" in line
    assert watch.seen.count(ROWS) == 2
    (first, _) = sorted((tmp_path / "out").glob("*.h5"))
    assert {"volume", *METRICS} <= set(read_shard(first).grasps.metrics)
    assert add(tried, tmp_path / "out", add=("volume", "hold"), settings=()).written == []


def test_what_cannot_be_tried(tried, add, tmp_path):
    shard = read_shard(sorted(tried.glob("*.h5"))[0])
    cloud = replace(shard.objects[0], faces=np.zeros((0, 3), np.int32), normals=shard.objects[0].vertices)
    unit = cloud.vertices / np.linalg.norm(cloud.vertices, axis=1, keepdims=True)
    write_shard(tmp_path / "cloud.h5", replace(shard, objects=[replace(cloud, normals=unit)]))
    with pytest.raises(ShardError, match="point cloud; the hold test needs a mesh"):
        add(tmp_path / "cloud.h5", tmp_path / "out")
    two = [replace(shard.objects[0], id=name) for name in ("a", "b")]
    write_shard(tmp_path / "two.h5", replace(shard, objects=two))
    with pytest.raises(ShardError, match="one object a shard"):
        add(tmp_path / "two.h5", tmp_path / "out")
    with pytest.raises(ConfigError, match=r"hold\.drawz"):
        add(tried, tmp_path / "out", settings=("hold.drawz=2",))


def test_copies_of_another_version_are_not_taken(tried, add, tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr("lgrasp.jobs.metrics.HOLD_VERSION", 0)
        add(tried, tmp_path / "out")
    with pytest.raises(OutputError, match=r"has hold measured with other numbers \(by another version of lgrasp\)"):
        add(tried, tmp_path / "out")

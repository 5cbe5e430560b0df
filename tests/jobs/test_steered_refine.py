"""Rows that are moved obey what was asked of them before, told from the rows alone."""

from dataclasses import replace

import numpy as np
import pytest
from support.rows_touching import touching

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as run_job
from lgrasp.errors import ConfigError, ShardError
from lgrasp.grasp.outcomes import FAILED_BOUNDS
from lgrasp.jobs.refine.shards import RefineJob
from lgrasp.judge.run import judge
from lgrasp.stages.refine.params import RefineParams

STILL = RefineParams(matching_rounds=0)


def told_otherwise(shard, told):
    """The shard, whose config says that this was asked as well."""
    steered = shard.header.config.get("steered", {}) | told
    return replace(shard, header=replace(shard.header, config=shard.header.config | {"steered": steered}))


@pytest.fixture
def refined(cache_root, tmp_path):
    """refined(shard, **options): the shard, refined, and the report of the judge."""

    def refined(shard, **options):
        source, cache = tmp_path / "source", Cache(cache_root, lambda line: None)
        write_shard(source / "mug.h5", shard)
        job = RefineJob(shards=(source,), out=tmp_path / "refined", device="cpu", cache=cache, **options)
        (path,) = run_job(job).paths
        return read_shard(path), judge(path)

    return refined


@pytest.mark.parametrize(
    "asked",
    [
        {"fingers": "thumb,index,middle", "above": "0,0,1,0.001"},
        {"grasp_type": "tripod", "approach": "1,0,0:60"},
        {"touch": "box:-1,-1,0.04:1,1,1:0.7", "avoid": "box:-1,-1,-1:1,1,0.02"},
    ],
)
def test_refined_rows_obey(steered, refined, asked):
    """Hands that were moved by millimetres touch again as is asked, and the shard says so still."""
    shard, _ = steered(rows=12, **asked)
    by = np.random.default_rng(0).normal(0, [0.003] * 3 + [0] * 4, shard.grasps.object_pose.shape)
    moved = replace(shard.grasps, object_pose=(shard.grasps.object_pose + by).astype(np.float32))
    found, report = refined(replace(shard, grasps=moved))
    assert len(found.grasps) >= 5
    assert report.passed
    assert found.grasps.metrics["refined"].sum() >= 5
    assert found.header.config["steered"] == shard.header.config["steered"]
    assert found.objects[0].touch_share == shard.objects[0].touch_share
    np.testing.assert_array_equal(found.objects[0].regions, shard.objects[0].regions)


@pytest.mark.parametrize("told", [{"every": [["link_11.0_tip"]]}, {"approach": {"direction": [-1, 0, 0], "angle": 5}}])
def test_rows_that_do_not_obey_are_invalid(steered, refined, told):
    shard, _ = steered(rows=4, approach="1,0,0:60", fingers="thumb,index,middle")
    found, report = refined(told_otherwise(shard, told), params=STILL, keep_invalid=True)
    assert not found.grasps.metrics["valid"].any()
    assert (found.grasps.metrics["failed_bound"] == FAILED_BOUNDS.index("steered")).all()
    assert report.failed["steered"].all()


def test_links_that_may_not_touch_are_no_contacts(steered, refined):
    shard, _ = steered(rows=10, links="link_15.0_tip,link_3.0_tip,link_7.0_tip,link_11.0_tip")
    fewer = ["link_15.0_tip", "link_3.0_tip", "link_7.0_tip"]
    assert not all(links <= set(fewer) for links in touching(shard))
    found, report = refined(told_otherwise(shard, {"links": fewer}), params=STILL)
    assert len(found.grasps)
    assert all(links <= set(fewer) for links in touching(found))
    assert report.passed


@pytest.mark.parametrize(
    ("told", "message"),
    [
        ({"links": ["thumb"]}, "'thumb' is no link of hand 'allegro'"),
        ({"links": 3}, "not iterable"),
        ({"links": []}, "none that has contact surface"),
        ({"approach": {"direction": [0, 0, 1], "angle": 20}}, "facing"),
        ({"approach": {"direction": [0, 0, 0]}, "facing": [0, 0, 1]}, "must not be zero"),
    ],
)
def test_what_is_asked_in_a_form_of_its_own_is_refused(steered, refined, told, message):
    shard, _ = steered(rows=2)
    with pytest.raises(ShardError, match=rf"mug\.h5: 'steered' in its config: .*{message}"):
        refined(told_otherwise(shard, told))


def test_stage_refine_obeys(steered):
    _, path = steered(load_pipeline("swift-refine"), fingers="thumb,index,middle", touch="box:-1,-1,0.04:1,1,1:0.7")
    assert judge(path).passed


def test_hands_that_are_moved_afterwards_are_not_placed(run, tmp_path):
    for asked in ({"above": "0,0,1,0.02"}, {"pose": __file__}):
        pipeline = load_pipeline("swift-refine").with_steering(**asked)
        with pytest.raises(ConfigError, match=f"with steer.{next(iter(asked))}: not with stage refine"):
            run(pipeline=pipeline, rows=2, out=tmp_path)

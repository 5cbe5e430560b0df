"""Keeps the grasps that hold as often as the bound asks, and writes how often they do."""

from dataclasses import replace

import numpy as np
import pytest

from lgrasp.config import parse_model
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.errors import ConfigError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.tables import GraspTable, grasp_arrays, take_grasps
from lgrasp.hold.run import METRICS
from lgrasp.jobs.requests.shards import RefineRequest
from lgrasp.judge.run import judge
from lgrasp.stages.context import Context
from lgrasp.stages.hold.params import HoldParams
from lgrasp.stages.hold.stage import run

FEW = HoldParams(draws=2)


@pytest.fixture(scope="module")
def grasps(tables) -> GraspTable:
    return take_grasps(tables.filter, np.arange(24))


@pytest.fixture(scope="module")
def all_rows(grasps, context) -> tuple[GraspTable, dict[str, int]]:
    return run(grasps, FEW, context)


def asking(context: Context, least: float) -> Context:
    return replace(context, bounds=GraspBounds(min_hold_probability=least))


def test_a_bound_of_0_keeps_all_rows(grasps, all_rows):
    table, counts = all_rows
    assert counts == {"tried": len(grasps), "held": len(grasps)}
    assert set(table.metrics) - set(grasps.metrics) == set(METRICS)
    for name, values in grasp_arrays(grasps).items():
        np.testing.assert_array_equal(grasp_arrays(table)[name], values, err_msg=name)
    assert 0 < table.metrics["hold_success"].sum() < len(table)


@pytest.mark.parametrize("least", [0.5, 1.0])
def test_rows_meet_the_bound(grasps, all_rows, context, least):
    """They are those that meet it without the bound, in their order, with the same metrics."""
    table, counts = run(grasps, FEW, asking(context, least))
    every = all_rows[0]
    meets = (every.metrics["hold_success"] == 1) & (every.metrics["hold_probability"] >= least)
    assert counts == {"tried": len(grasps), "held": meets.sum()}
    assert 0 < meets.sum() < len(grasps)
    kept = grasp_arrays(take_grasps(every, np.flatnonzero(meets)))
    for name, values in grasp_arrays(table).items():
        np.testing.assert_array_equal(values, kept[name], err_msg=name)
    assert np.isfinite(table.metrics["hold_drift"]).all()


def test_open_hands_hold_nothing(grasps, context):
    opened = replace(grasps, q=grasps.q_pregrasp, q_squeeze=grasps.q_pregrasp)
    table, counts = run(opened, FEW, asking(context, 0.5))
    assert counts["held"] == len(table) == 0
    assert set(METRICS) <= set(table.metrics)


def test_no_grasps(grasps, context):
    table, counts = run(take_grasps(grasps, np.arange(0)), FEW, context)
    assert counts == {"tried": 0, "held": 0}
    assert len(table) == 0


def test_a_bound_without_the_stage_is_refused():
    with pytest.raises(ConfigError, match=r"min_hold_probability is 0\.5, which only stage hold tells"):
        load_pipeline("robust").with_settings(["bounds.min_hold_probability=0.5"])


def test_robust_hold_is_robust_and_then_hold():
    before, both = load_pipeline("robust"), load_pipeline("robust-hold")
    assert both.bounds == before.bounds.model_copy(update={"min_hold_probability": 1.0})
    assert both.order == (*before.order, "hold")
    assert all(both.params(stage) == before.params(stage) for stage in before.order)


def test_refine_refuses_the_bound():
    asked = {"shards": ["x.h5"], "out": "y", "settings": ["bounds.min_hold_probability=0.5"]}
    with pytest.raises(ConfigError, match="min_hold_probability must be 0"):
        parse_model(RefineRequest, asked, "refine").numbers(GraspBounds())
    told = GraspBounds(min_hold_probability=1.0)
    assert parse_model(RefineRequest, asked | {"settings": []}, "refine").numbers(told)[0].min_hold_probability == 0


def test_robust_hold_writes_valid_rows_with_its_metrics(swift, job, tmp_path):
    pipeline = load_pipeline("robust-hold").with_settings(["hold.draws=2"]).model_copy(update={"field": swift.field})
    (path,) = generate(job(pipeline=pipeline, rows=12, shard_rows=12, out=tmp_path / "made")).paths
    shard = read_shard(path)
    metrics = shard.grasps.metrics
    assert len(shard.grasps) == 12
    assert (metrics["hold_success"] == 1).all()
    assert (metrics["hold_probability"] == 1).all()
    assert (metrics["hold_drift"] < 0.05).all()
    assert [shard.grasps.metric_units[name] for name in METRICS] == ["", "", "m"]
    assert validate_shard(path) == []
    assert judge(path).valid.all()

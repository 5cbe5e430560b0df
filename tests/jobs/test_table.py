"""Grasps of an object that rests on a table."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lgrasp.config import parse_model
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.run import run as generate
from lgrasp.engine.run import run as run_job
from lgrasp.errors import ConfigError, ShardError
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.records import Shard
from lgrasp.jobs.config import JobConfig, plan_requests
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.refine.shards import RefineJob
from lgrasp.jobs.requests.search import SearchRequest
from lgrasp.judge.run import judge
from lgrasp.stages.refine.params import RefineParams


@pytest.fixture(scope="module")
def on_table(swift, small_job, tmp_path_factory):
    """A shard of grasps on a table, and what the job reports of it."""
    changes = {"rows": 16, "shard_rows": 16, "pipeline": swift.with_table(), "out": tmp_path_factory.mktemp("table")}
    outcome = generate(GenerateJob(**small_job | changes))
    (path,) = outcome.paths
    return path, outcome.job.report(outcome)


def test_hands_are_above_the_table(on_table, solids, link_poses):
    """At the grasp, open, and all the way there, by points of the links and the planes in the shard."""
    path, report = on_table
    assert validate_shard(path) == []
    shard = read_shard(path)
    rows, (obj,) = shard.grasps, shard.objects
    T = pose_matrix(rows.object_pose[:, 0].astype(float))
    tables = np.asarray(obj.tables)
    plane = tables[rows.table["pose"]].astype(float)
    up = np.einsum("nij,nj->ni", T[:, :3, :3], plane[:, :3])
    height = plane[:, 3] + np.einsum("ni,ni->n", up, T[:, :3, 3])
    back = -rows.table["approach"]
    assert (np.einsum("ni,ni->n", back, up) > -1e-5).all()
    closing = [(rows.q_pregrasp + t * (rows.q - rows.q_pregrasp), 0.0) for t in np.linspace(0, 1, 9)]
    for q, way in (*closing, (rows.q_pregrasp, 0.15)):
        links = link_poses(q)
        for solid in solids.solids:
            L = links[:, solid.link]
            points = np.einsum("nij,pj->npi", L[:, :3, :3], solid.samples) + (L[:, :3, 3] + way * back)[:, None]
            assert (np.einsum("npi,ni->np", points, up) - height[:, None]).min() > 0.0009
    assert [pose["rows"] for pose in report["resting"]] == np.bincount(
        rows.table["pose"], minlength=len(tables)
    ).tolist()
    assert sum(pose["probability"] for pose in report["resting"]) == pytest.approx(1.0, abs=1e-5)
    likely = [pose["rows"] > 0 for pose in report["resting"] if pose["probability"] >= 0.05]
    assert np.mean(likely) >= 0.8


def test_judge_agrees_and_finds_rows_in_the_table(on_table, tmp_path):
    path, _ = on_table
    assert judge(path).valid_share == 1.0
    moved = shutil.copy(path, tmp_path)
    with h5py.File(moved, "r+") as file:
        tables, pose, way = (file[n] for n in ("objects/mug/tables", "grasps/table/pose", "grasps/table/approach"))
        pose[0] = int(np.argmin(tables[:, :3] @ tables[pose[0], :3]))  # the plane that faces its own
        way[1] = -way[1]
    failed = judge(moved).failed
    for row, check in enumerate(("table", "approach")):
        assert failed[check][row]
        assert not failed[check][2:].any()
    with h5py.File(moved, "r+") as file:
        tables = file["objects/mug/tables"]
        tables[:, 3] = tables[:, 3] - 0.002
    assert judge(moved, rows=5).failed["resting"].any()


@pytest.fixture
def refined(cache_root, tmp_path):
    """refined(shard, **changes): the shard that ``lgrasp refine`` makes of one."""

    def refined(shard: Shard, out: str = "refined", **changes) -> Path:
        write_shard(tmp_path / "given.h5", shard)
        cache = Cache(cache_root, pytest.fail)
        job = RefineJob(shards=(tmp_path / "given.h5",), out=tmp_path / out, device="cpu", cache=cache, **changes)
        return run_job(job).paths[0]

    return refined


def test_refined_rows_stay_above_their_table(on_table, refined):
    """Every second hand is moved by millimetres: what is written passes the judge, table and way included."""
    shard = read_shard(on_table[0])
    rows, n = shard.grasps, len(shard.grasps)
    pose, spoilt = rows.object_pose.copy(), np.arange(n) % 2 == 0
    pose[spoilt, 0, :3] += 0.003 * np.random.default_rng(0).normal(size=(int(spoilt.sum()), 3)).astype("f4")
    given = replace(rows, object_pose=pose, candidate=np.arange(n, dtype=np.uint64))
    path = refined(replace(shard, grasps=given))
    assert validate_shard(path) == []
    after = read_shard(path)
    assert after.objects[0].tables is not None
    found = judge(path)
    assert found.valid_share == 1.0
    assert {"table", "resting", "approach"} <= set(found.failed)
    source = after.grasps.candidate.astype(int)
    np.testing.assert_array_equal(after.grasps.table["pose"], rows.table["pose"][source])
    same = after.grasps.metrics["refined"] == 0
    assert (same & ~spoilt[source]).any()
    assert (~same).any()
    np.testing.assert_array_equal(after.grasps.table["approach"][same], rows.table["approach"][source][same])


def test_rows_below_their_table_are_invalid(on_table, refined):
    """Nothing is searched: hands whose table is the plane that faces theirs are left out, or kept as invalid."""
    shard = read_shard(on_table[0])
    rows, (obj,), n = shard.grasps, shard.objects, len(shard.grasps)
    pose = rows.table["pose"].copy()
    up = np.asarray(obj.tables)[:, :3]
    pose[:5] = np.argmin(up @ up[pose[:5]].T, axis=0)
    given = replace(rows, table={**rows.table, "pose": pose}, candidate=np.arange(n, dtype=np.uint64))
    given = replace(shard, grasps=given)
    after = read_shard(refined(given, params=RefineParams(matching_rounds=0), keep_invalid=True)).grasps
    np.testing.assert_array_equal(after.metrics["valid"], np.arange(n) >= 5)
    np.testing.assert_array_equal(after.table["pose"], pose)
    np.testing.assert_allclose(after.table["approach"][5:], rows.table["approach"][5:], atol=1e-5)
    with pytest.raises(ShardError, match="table/pose: "):
        refined(replace(given, grasps=replace(given.grasps, table={**rows.table, "pose": pose + 99})), "none")


def test_asked_for_or_not(run, job, swift):
    """Without a table nothing of it is stored; a table is part of what decides the rows."""
    (path,) = run(rows=20, shard_rows=20).paths
    shard = read_shard(path)
    assert shard.grasps.table == {}
    assert shard.objects[0].tables is None
    assert job().key() != job(pipeline=swift.with_table()).key()


def test_same_rows_however_they_are_made(run, swift, grasps, tmp_path):
    """In other batches, by more workers, or continued from fewer rows."""
    table = {"pipeline": swift.with_table(), "shard_rows": 20}
    run(**table, rows=20, out=tmp_path / "whole")
    run(**table, rows=10, out=tmp_path / "grown")
    run(**table, rows=20, out=tmp_path / "grown", batch=300, workers=2)
    whole = grasps(tmp_path / "whole")
    grown = grasps(tmp_path / "grown")
    for column, values in whole.items():
        np.testing.assert_array_equal(grown[column], values, err_msg=column)


def test_config_asks_for_a_table():
    (request,) = plan_requests(parse_model(JobConfig, {"objects": ["mug"], "table": True}, "config"))
    assert isinstance(request, SearchRequest)
    assert request.pipeline.on_table
    assert request.out.name == "robust-table"


def test_pipelines_without_tables(job):
    """Grasps that are moved later, and sequences, have none."""
    for name in ("swift-refine", "sequence"):
        with pytest.raises(ConfigError, match=r"place\.table"):
            SearchRequest.check(job(pipeline=load_pipeline(name).with_table()))

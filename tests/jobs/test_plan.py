"""Plans as shards: judged by an independent oracle, with the cloud that they were made on."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from support.jaws import mesh_record

from lgrasp.cloud.read import Cloud
from lgrasp.config import parse_model
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import JobOutcome
from lgrasp.engine.report import job_report
from lgrasp.engine.run import run
from lgrasp.errors import ConfigError, ObjectError, OutputError
from lgrasp.grasp.records import Shard
from lgrasp.jobs.refine.plan import PlanJob
from lgrasp.judge.report import Report
from lgrasp.judge.run import judge
from lgrasp.object.find import find_object
from lgrasp.planning.params import PlanParams

PENETRATION, GAP, CLOUD_GAP, ANGLE = 2.0, 4.0, 6.0, 45.0  # [mm, deg] that docs/guides/refine.md promises
ROUNDING = 0.1  # [mm] of distance grids; the judge measures meshes
RADIUS, STARTS = 0.035, 8


@pytest.fixture(scope="module")
def plan(cache_root: Path) -> Callable[..., JobOutcome]:
    """plan(folder, **changes): plans of the Barrett hand."""

    def plan(out: Path, **changes) -> JobOutcome:
        job = {
            "hand": "barrett",
            "out": out,
            "starts": STARTS,
            "device": "cpu",
            "cache": Cache(cache_root, pytest.fail),
        }
        return run(parse_model(PlanJob, job | changes, "plan"))

    return plan


@pytest.fixture(scope="module")
def mug(plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shard of plans."""
    return plan(tmp_path_factory.mktemp("mug"), object="mug").paths[0]


def ball_on_table() -> Cloud:
    """A ball whose foot is hidden, and the table that it lies on; labels 3 and 0."""
    n = np.asarray(trimesh.creation.icosphere(subdivisions=4).vertices)
    n = n[n[:, 2] > -0.6]
    flat = np.random.default_rng(0).uniform(-0.2, 0.2, (3000, 2))
    flat = flat[np.linalg.norm(flat, axis=1) > 0.02]
    points = np.concatenate([RADIUS * n + [0, 0, RADIUS], np.column_stack([flat, np.zeros(len(flat))])])
    normals = np.concatenate([n, np.tile([0.0, 0, 1], (len(flat), 1))])
    labels = np.repeat([3, 0], [len(n), len(flat)])
    return Cloud(points.astype("f4"), normals.astype("f4"), labels, labels == 3, ())


@pytest.fixture(scope="module")
def ball(plan, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shard of plans of that ball."""
    return plan(tmp_path_factory.mktemp("ball"), cloud=ball_on_table()).paths[0]


def judged(shard: Shard, folder: Path, mesh: trimesh.Trimesh) -> Report:
    """The rows of a shard with a mesh in the place of their object."""
    path = folder / "judged.h5"
    write_shard(path, replace(shard, objects=[mesh_record(shard.objects[0].id, mesh)]))
    return judge(path)


def test_plans_keep_the_bounds_they_promise(mug):
    assert validate_shard(mug) == []
    report = judge(mug, mesh=find_object("mug"))
    assert report.rows >= STARTS // 2
    for check in ("finite", "indices", "limits", "mimic", "self_penetration", "contact_on_object"):
        assert report.failures[check] == 0, check
    assert report.values["penetration_mm"].max() <= PENETRATION + ROUNDING
    assert report.values["contact_link_mm"].max() <= GAP + ROUNDING
    assert report.values["normal_deg"].max() <= ANGLE + 1.0
    gap = 1e3 * read_shard(mug).grasps.metrics["gap"]
    np.testing.assert_allclose(report.values["contact_link_mm"], gap, atol=ROUNDING)


def test_two_fingers_touch_or_one_and_the_palm(mug):
    shard = read_shard(mug)
    names = np.array([name.split("_")[1] if name.startswith("finger") else "palm" for name in shard.hand.link_names])
    for links in shard.grasps.contact_links[:, 0]:
        assert len(set(names[links[links >= 0]])) >= 2


def test_rows_say_where_they_come_from(mug):
    shard = read_shard(mug)
    rows = len(shard.grasps)
    assert shard.header.pipeline == "plan"
    assert (np.diff(shard.grasps.candidate.astype(int)) > 0).all()
    assert shard.grasps.candidate.max() < STARTS
    counts = {name: int(n) for name, n in shard.statistics.items() if name.startswith("plan_")}
    assert counts.pop("plan_starts") == sum(counts.values()) == STARTS
    assert counts["plan_kept"] == rows
    assert PlanParams.model_validate(shard.header.config["plan"]) == PlanParams()


def test_the_cloud_is_stored_with_its_normals(ball):
    assert validate_shard(ball) == []
    (record,) = read_shard(ball).objects
    cloud = ball_on_table()
    np.testing.assert_array_equal(record.vertices, cloud.points[cloud.target])
    assert record.normals is not None
    np.testing.assert_allclose(record.normals, cloud.normals[cloud.target], atol=1e-6)
    assert len(record.faces) == 0
    assert not record.watertight


def test_plans_of_a_cloud_hold_what_was_seen(ball, tmp_path):
    """The true ball and the true table decide."""
    shard = read_shard(ball)
    assert len(shard.grasps) >= 3
    solid = trimesh.creation.icosphere(subdivisions=5, radius=RADIUS).apply_translation([0, 0, RADIUS])
    report = judged(shard, tmp_path, solid)
    assert report.values["penetration_mm"].max() <= PENETRATION + 1.0
    assert report.values["contact_object_mm"].max() <= 2.0
    assert report.values["contact_link_mm"].max() <= CLOUD_GAP + 1.0
    slab = trimesh.creation.box((0.4, 0.4, 0.05)).apply_translation([0, 0, -0.025])
    assert judged(shard, tmp_path, slab).values["penetration_mm"].max() <= PENETRATION + 1.0


def test_without_a_plan_the_shard_is_empty_and_stays(plan, tmp_path):
    """A bin that no hand reaches around; it is not planned again."""
    n = np.asarray(trimesh.creation.icosphere(subdivisions=3).vertices)
    cloud = Cloud((0.8 * n).astype("f4"), n.astype("f4"), None, np.ones(len(n), bool), ())
    few = {"cloud": cloud, "starts": 2, "params": PlanParams(rolls=8, finalists=2)}
    outcome = plan(tmp_path / "out", **few)
    assert outcome.rows == outcome.job.report(outcome)["counts"]["kept"] == 0
    assert not validate_shard(outcome.paths[0])
    again = plan(tmp_path / "out", **few)
    assert (again.results, again.paths) == ([], outcome.paths)
    assert str(again.job.shortfall(again)) == str(outcome.job.shortfall(outcome))
    assert job_report(again)["epsilon"] is None


def test_what_is_there_is_replaced_only_if_asked(mug, plan):
    before = mug.read_bytes()
    assert plan(mug.parent, object="mug").present == len(read_shard(mug).grasps)
    with pytest.raises(OutputError, match="--overwrite"):
        plan(mug.parent, object="mug", starts=5)
    assert mug.read_bytes() == before


def test_bad_jobs(plan, tmp_path):
    cloud = ball_on_table()
    for changes, words in (
        ({}, "one of the two"),
        ({"object": "mug", "cloud": cloud}, "one of the two"),
        ({"object": "mug", "starts": 0}, "'starts' = 0"),
        ({"object": "mug", "stand_off": np.nan}, "'stand_off' = nan"),
    ):
        with pytest.raises(ConfigError, match=words):
            plan(tmp_path / "out", **changes)
    for points, words in ((1e3 * cloud.points, "metres"), (cloud.points * np.nan, "NaN")):
        with pytest.raises(ObjectError, match=words):
            plan(tmp_path / "out", cloud=replace(cloud, points=points))
    assert not (tmp_path / "out").exists()

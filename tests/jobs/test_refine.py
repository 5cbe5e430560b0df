"""Refined shards: rows keep their places and their ids, and those that were replaced pass an independent judge."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.wrench import unresisted

from lgrasp.dataset.merge import merge_shards
from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.torch_dataset import GraspDataset
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.report import job_report
from lgrasp.engine.run import run
from lgrasp.engine.run import run as generate
from lgrasp.errors import OutputError, ShardError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.records import GraspRows, Shard
from lgrasp.grasp.schema import GRASP_FIELDS
from lgrasp.hold.run import METRICS
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.refine import moved, shards
from lgrasp.jobs.refine.shards import RefineJob, move_rows
from lgrasp.jobs.simulate import SimulateJob
from lgrasp.judge.run import judge
from lgrasp.simulate.protocol import find_protocol
from lgrasp.stages.refine.params import RefineParams

ROWS = 30
SPOILT = np.arange(ROWS) % 2 == 0


@pytest.fixture(scope="module")
def source(small_job: dict[str, Any], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A shard of valid grasps of which every second hand was moved by millimetres, with verdicts of a simulator."""
    folder = tmp_path_factory.mktemp("source")
    made = generate(GenerateJob(**small_job | {"rows": ROWS, "shard_rows": ROWS, "out": folder / "made"}))
    shard = read_shard(made.paths[0])
    rows = replace(
        spoil(shard.grasps, shard),
        candidate=np.arange(ROWS, dtype=np.uint64),  # rows of one pose have one number; here each tells its row
        physics={"fc_holds": np.ones(ROWS, bool)},
        physics_protocols={"fc_holds": '{"name": "fc"}'},
    )
    told = {**shard.statistics, "fc_tried": ROWS, "fc_held": ROWS, "seconds_fc": 1.0}
    write_shard(folder / "shards" / "mug.h5", replace(shard, grasps=rows, statistics=told))
    return folder / "shards" / "mug.h5"


def spoil(rows: GraspRows, shard: Shard) -> GraspRows:
    """Every second hand off by 4 mm and 3 degrees an axis, and 3 degrees a joint."""
    rng, n = np.random.default_rng(0), int(SPOILT.sum())
    pose, q = rows.object_pose.copy(), rows.q.copy()
    turned = Rotation.from_rotvec(0.05 * rng.normal(size=(n, 3))) * Rotation.from_quat(
        pose[SPOILT, 0, 3:], scalar_first=True
    )
    pose[SPOILT, 0, :3] += 0.004 * rng.normal(size=(n, 3))
    pose[SPOILT, 0, 3:] = turned.as_quat(canonical=True, scalar_first=True)
    q[SPOILT] += 0.05 * rng.normal(size=(n, q.shape[1]))
    return replace(rows, object_pose=pose, q=np.clip(q, shard.hand.joint_lower, shard.hand.joint_upper))


@pytest.fixture(scope="module")
def refine(cache_root: Path) -> Callable[..., Path]:
    """refine(source, folder, **changes): the one shard that comes of it."""

    def refine(source: Path, out: Path, **changes) -> Path:
        cache = Cache(cache_root, pytest.fail)
        (done,) = run(RefineJob(shards=(source,), out=out, device="cpu", cache=cache, **changes)).paths
        return done

    return refine


@pytest.fixture(scope="module")
def done(refine, source, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return refine(source, tmp_path_factory.mktemp("refined"))


def both(source: Path, done: Path) -> tuple[GraspRows, GraspRows, np.ndarray]:
    """Rows before and after, of those that were written, and which of these were replaced."""
    before, after = read_shard(source).grasps, read_shard(done).grasps
    kept = np.isin(before.candidate, after.candidate)
    columns = {name: getattr(before, name)[kept] for name in GRASP_FIELDS}
    metrics = {name: values[kept] for name, values in before.metrics.items()}
    physics = {name: values[kept] for name, values in before.physics.items()}
    return replace(before, **columns, metrics=metrics, physics=physics), after, after.metrics["refined"] == 1


def numbers(done: Path) -> tuple[tuple[float, float], tuple[float, float]]:
    """Valid rows before and after, and mean energies, as the shard tells."""
    shard = read_shard(done)
    before, metrics = shard.statistics, shard.grasps.metrics
    valid = float(before["refine_valid_before"]), float(metrics["valid"].sum())
    energy = float(before["refine_energy_before"]) / float(before["refine_tried"]), float(metrics["energy"].mean())
    return valid, energy


def test_rows_keep_their_places_and_ids(source, done):
    assert validate_shard(done) == []
    assert done.name == source.name
    before, after = read_shard(source), read_shard(done)
    rows = len(after.grasps)
    assert ROWS / 2 < rows == ROWS - int(after.statistics["refine_failed"])
    places = np.searchsorted(before.grasps.candidate, after.grasps.candidate)
    np.testing.assert_array_equal(before.grasps.candidate[places], after.grasps.candidate)
    assert after.header.config["bounds"] == GraspBounds().describe()
    assert after.hand.sha256 == before.hand.sha256
    assert after.header.config["run_key"] == before.header.config["run_key"]
    assert after.header.config["refine"]["matching_rounds"] > 0
    assert after.statistics["refine_tried"] == ROWS
    assert not any(name.startswith(("fc_", "seconds_fc")) for name in after.statistics)
    assert after.statistics["refine_replaced"] == (after.grasps.metrics["refined"] == 1).sum()
    for a, b in zip(after.objects, before.objects, strict=True):
        np.testing.assert_array_equal(a.vertices, b.vertices)


def test_rows_that_stay_are_as_they_were(source, done):
    before, after, replaced = both(source, done)
    assert 0 < replaced.sum() < len(after)
    old, new = before.columns(), after.columns()
    for name, values in old.items():
        if name.startswith("physics/"):
            assert name not in new  # a verdict of rows that are no longer all there
            continue
        kept = new[name][~replaced]
        if values.ndim == 4 or name == "contact_links":  # contacts are padded to the widest row
            width = values.shape[2]
            assert (kept[:, :, width:] == -1).all() if name == "contact_links" else np.isnan(kept[:, :, width:]).all()
            kept = kept[:, :, :width]
        np.testing.assert_array_equal(kept, values[~replaced], err_msg=name)


def test_rows_that_stay_are_measured_by_the_bounds_asked(source, refine, tmp_path):
    """Joints that are controlled ten times as stiffly squeeze with targets that are a tenth as far ahead."""
    done = refine(source, tmp_path, settings=("bounds.squeeze_stiffness=50",))
    before, after, replaced = both(source, done)
    assert 0 < replaced.sum() < len(after)
    np.testing.assert_array_equal(after.q[~replaced], before.q[~replaced])
    np.testing.assert_array_equal(after.object_pose[~replaced], before.object_pose[~replaced])
    ahead = [np.abs(rows.q_squeeze - rows.q)[~replaced].max(1) for rows in (before, after)]
    assert np.median(ahead[1] / ahead[0]) == pytest.approx(0.1, rel=0.2)
    assert (after.metrics["stable_squeeze"] > before.metrics["stable_squeeze"])[~replaced].mean() > 0.8
    assert validate_shard(done) == []


def test_every_row_passes_the_judge(source, done):
    """Rows that were valid, and most of those that were spoilt; ``valid`` says of each what the judge finds."""
    _, after, replaced = both(source, done)
    report = judge(done)
    assert report.valid.all(), report
    assert (after.metrics["valid"] == 1).all()
    assert not judge(source).valid[SPOILT].any()
    spoilt = np.isin(after.candidate, read_shard(source).grasps.candidate[SPOILT])
    assert replaced[spoilt].all()
    assert spoilt.sum() >= 0.6 * SPOILT.sum()
    assert numbers(done)[0] == ((~SPOILT).sum(), len(after))


def test_a_valid_row_is_replaced_by_one_that_resists_pulls_better(source, done, refine, tmp_path):
    """By one that was moved, or that touches at more links than the row says."""
    still = refine(source, tmp_path, params=RefineParams(matching_rounds=0))
    before, after, _ = both(source, still)
    np.testing.assert_array_equal(after.q, before.q)
    np.testing.assert_allclose(after.object_pose, before.object_pose, atol=1e-6)
    for shard, least in ((still, 0), (done, 4)):
        before, after, replaced = both(source, shard)
        improved = replaced & np.isin(after.candidate, read_shard(still).grasps.candidate)
        assert improved.sum() >= least
        assert (after.metrics["unresisted_load"][improved] < before.metrics["unresisted_load"][improved]).all()
    mesh = read_shard(source).objects[0]
    centre = trimesh.Trimesh(mesh.vertices, mesh.faces).center_mass
    for row in np.flatnonzero(improved).tolist():
        assert unheld(after, row, centre) < unheld(before, row, centre)


def unheld(rows: GraspRows, row: int, centre: np.ndarray) -> float:
    """Unresisted part of a unit force along an axis of the hand, by the reference, from the contacts stored."""
    there = rows.contact_links[row, 0] >= 0
    points, normals = (values[row, 0, there].astype(float) for values in (rows.contact_points, rows.contact_normals))
    turn = Rotation.from_quat(rows.object_pose[row, 0, 3:], scalar_first=True).inv()
    return unresisted(points - centre, -normals, 0.5, turn.apply(np.vstack([np.eye(3), -np.eye(3)])))


def test_energies_are_those_of_the_postures_stored(source, done, refine, tmp_path):
    """Refined by nothing, the refined rows have the energies that were told of them."""
    _, after, _ = both(source, done)
    still = refine(done, tmp_path, params=RefineParams(matching_rounds=0))
    np.testing.assert_allclose(read_shard(still).grasps.metrics["energy"], after.metrics["energy"], rtol=1e-3)
    _, energy = numbers(done)
    assert energy[1] < energy[0]


def test_invalid_rows_are_kept_when_asked_with_their_own_metrics(source, refine, tmp_path):
    """Nothing is searched: spoilt rows stay invalid, and what is stored of them is what they are."""
    done = refine(source, tmp_path, keep_invalid=True, params=RefineParams(matching_rounds=0))
    after = read_shard(done).grasps
    np.testing.assert_array_equal(after.metrics["valid"], ~SPOILT)
    assert validate_shard(done) == []
    found = judge(done)
    np.testing.assert_array_equal(found.valid, ~SPOILT)
    depth = found.values["penetration_mm"]
    np.testing.assert_allclose(1000 * after.metrics["penetration"], depth, rtol=0.1, atol=0.6)
    assert depth.max() > 2


def test_metrics_of_the_hold_test_are_left_out(source, done, refine, tmp_path):
    """Refined postures were not tried, and the bound is not asked of them; all else is as without."""
    shard = read_shard(source)
    tried = {name: np.ones(ROWS, "f4") for name in METRICS}
    rows = replace(shard.grasps, metrics={**shard.grasps.metrics, **tried})
    config = {**shard.header.config, "bounds": GraspBounds(min_hold_probability=1.0).describe()}
    write_shard(tmp_path / "tried.h5", replace(shard, grasps=rows, header=replace(shard.header, config=config)))
    without, done = read_shard(done), read_shard(refine(tmp_path / "tried.h5", tmp_path / "out"))
    for name, values in without.grasps.columns().items():
        np.testing.assert_array_equal(done.grasps.columns()[name], values, err_msg=name)
    assert not set(METRICS) & set(done.grasps.metrics)
    assert done.header.config["bounds"]["numbers"]["min_hold_probability"] == 0


def test_a_row_does_not_depend_on_the_others(source, done, refine, tmp_path):
    shard = read_shard(source)
    some = np.array([7, 4, 21, 12])
    rows = shard.grasps
    part = replace(rows, **{name: getattr(rows, name)[some] for name in GRASP_FIELDS}, metrics={}, physics={})
    write_shard(tmp_path / "part.h5", replace(shard, grasps=part))
    after = read_shard(done).grasps
    found = read_shard(refine(tmp_path / "part.h5", tmp_path / "out")).grasps
    assert set(found.candidate) == set(rows.candidate[some]) & set(after.candidate)
    same = [after.candidate.tolist().index(c) for c in found.candidate]
    np.testing.assert_array_equal(found.metrics["refined"], after.metrics["refined"][same])
    np.testing.assert_allclose(found.q, after.q[same], atol=1e-5)
    np.testing.assert_allclose(found.object_pose, after.object_pose[same], atol=1e-5)


def test_shards_without_rows_are_left_out(source, cache_root, tmp_path):
    shard = read_shard(source)
    rows = shard.grasps
    none = replace(rows, **{name: getattr(rows, name)[:0] for name in GRASP_FIELDS}, metrics={}, physics={})
    write_shard(tmp_path / "none.h5", replace(shard, grasps=none))
    told: list[str] = []
    given: dict[str, Any] = {"out": tmp_path / "out", "device": "cpu", "cache": Cache(cache_root, told.append)}
    with pytest.raises(ShardError, match="no grasps to refine"):
        run(RefineJob(shards=(tmp_path / "none.h5",), **given))
    assert not told
    assert not (tmp_path / "out").exists()


def test_a_source_that_is_replaced_meanwhile(source, cache_root, tmp_path, monkeypatch):
    """What was made of its old rows is not taken for what the new ones give."""
    path, shard = tmp_path / "in.h5", read_shard(source)
    before, after = (
        replace(
            shard.grasps, **{name: getattr(shard.grasps, name)[rows] for name in GRASP_FIELDS}, metrics={}, physics={}
        )
        for rows in (slice(1, 3), slice(3, 5))
    )
    write_shard(path, replace(shard, grasps=before))

    def replacing(*args, **options):
        write_shard(path, replace(shard, grasps=after))
        return move_rows(*args, **options)

    monkeypatch.setattr(shards, "move_rows", replacing)
    given: dict[str, Any] = {"params": RefineParams(matching_rounds=0), "device": "cpu", "cache": Cache(cache_root)}
    refined = RefineJob(shards=(path,), out=tmp_path / "out", **given)
    run(refined)
    with pytest.raises(OutputError, match="belongs to another run"):
        run(refined.changed())


def test_a_shard_of_which_no_row_passes_is_empty_and_stays(job, cache_root, tmp_path):
    """It conforms to the format, and is not computed again."""
    last = generate(job(object="sphere", rows=4, shard_rows=2, out=tmp_path / "made")).paths[1]
    shard = read_shard(last)
    pose = shard.grasps.object_pose + np.array([0.1, 0, 0, 0, 0, 0, 0], np.float32)
    write_shard(last, replace(shard, grasps=replace(shard.grasps, object_pose=pose)))
    params, out = RefineParams(matching_rounds=0), tmp_path / "out"
    given: dict[str, Any] = {"device": "cpu", "cache": Cache(cache_root)}
    refined = RefineJob(shards=(tmp_path / "made",), out=out, params=params, **given)
    first = run(refined)
    assert [part.rows for part, _ in first.made_parts] == [2, 2]
    assert [made.rows for _, made in first.made_parts] == [2, 0]
    assert not validate_shard(first.paths[1])
    assert [one["energy"] is None for one in job_report(first)["results"]] == [False, True]
    again = run(refined.changed())
    assert (again.results, again.present, again.paths) == ([], 2, first.paths)
    assert len(judge(out).valid) == 2
    assert merge_shards(first.paths, tmp_path / "all.h5") == 2
    assert len(GraspDataset(out)) == 2
    simulated = run(SimulateJob(shards=(out,), protocol=find_protocol("fc"), out=tmp_path / "simulated", **given))
    assert len(simulated.paths) == 2
    job_report(simulated)


def test_grasps_shaken_by_millimetres_are_recovered(job, refine, tmp_path):
    """The object off by 4 mm an axis: most are valid again, and no invalid row is written."""
    rows = 20
    made = generate(job(object="sphere", rows=rows, shard_rows=rows, out=tmp_path / "made"))
    shard = read_shard(made.paths[0])
    pose = shard.grasps.object_pose.copy()
    pose[:, 0, :3] += 0.004 * np.random.default_rng(0).normal(size=(len(pose), 3))
    write_shard(tmp_path / "shaken.h5", replace(shard, grasps=replace(shard.grasps, object_pose=pose)))
    done = refine(tmp_path / "shaken.h5", tmp_path / "out")
    report = judge(done)
    assert report.valid.all(), report
    assert len(report.valid) >= 0.85 * rows
    assert numbers(done)[0][0] < 0.1 * rows


def test_rows_are_moved_in_smaller_parts_where_memory_runs_out(source, done, refine, tmp_path, monkeypatch):
    sizes, move = [], moved._moved_part

    def short(*args):
        part = next(a for a in args if isinstance(a, slice))
        sizes.append(part.stop - part.start)
        if sizes[-1] > 4:
            raise RuntimeError("Failed to allocate 490680320 bytes on device 'cuda:0'")
        return move(*args)

    monkeypatch.setattr(moved, "_moved_part", short)
    monkeypatch.setattr(moved, "_batch_rows", lambda device: 16)
    monkeypatch.setattr(moved, "_BATCH_ROWS", 4)
    found, whole = (read_shard(path).grasps for path in (refine(source, tmp_path), done))
    assert sizes[:3] == [16, 8, 4]
    np.testing.assert_array_equal(found.q, whole.q)
    np.testing.assert_array_equal(found.object_pose, whole.object_pose)

"""A network is trained on sequences and draws others: what it draws is checked like all grasps."""

import numpy as np
import pytest
import torch
from scipy.spatial.distance import cdist
from support.sequences import OBJECTS, small_inputs, small_pipeline

from lgrasp.cloud import model
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.engine.batch import run_stage, run_stages
from lgrasp.engine.cache import Cache
from lgrasp.engine.run import run
from lgrasp.errors import ConfigError
from lgrasp.geometry.edges import face_normals
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.held import hold
from lgrasp.grasp.predicted import TouchingGrasps, upload_predicted
from lgrasp.jobs.config import load_requests
from lgrasp.jobs.learn.diffuser import DiffuserJob, evaluate
from lgrasp.jobs.learn.sequences import read_steps
from lgrasp.jobs.requests.shards import DiffuserRequest
from lgrasp.jobs.sequence.job import SequenceJob
from lgrasp.jobs.sequence.round import run_round
from lgrasp.jobs.sequence.sample import SampleJob
from lgrasp.learn.diffuser.file import load_diffuser
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.object.surface import sample_surface
from lgrasp.runtime.fetch import fetch
from lgrasp.runtime.tally import Meter
from lgrasp.sequence.touching_sets import touching_sets
from lgrasp.stages.context import Context

TINY = {"width": 32, "blocks": 2, "shape_points": 48, "held_points": 48, "cloud": 128, "turns": 4, "batch": 64}
TINY |= {"dropout": 0.0, "blind": 0.0, "rate": 5.0e-3, "average": 0.98}


@pytest.fixture(scope="module")
def cache(cache_root):
    return Cache(cache_root, pytest.fail)


@pytest.fixture(scope="module")
def inputs(cache_root):
    return small_inputs(small_pipeline(), cache_root)


@pytest.fixture(scope="module")
def asked(cache):
    return {"objects": OBJECTS, "scale": "0.06:0.08", "device": "cpu", "cache": cache}


@pytest.fixture(scope="module")
def shards(asked, tmp_path_factory):
    out = tmp_path_factory.mktemp("sequences")
    run(SequenceJob(**asked, rows=40, pipeline=small_pipeline(), out=out))
    return out


@pytest.fixture(scope="module")
def network(shards, cache, tmp_path_factory):
    out = tmp_path_factory.mktemp("network") / "net.pt"
    params = DiffuserParams.model_validate(TINY | {"steps": 300})
    run(DiffuserJob(shards=(shards,), out=out, params=params, device="cpu", cache=cache))
    return out


def test_steps_are_those_of_the_rows(shards, cache, inputs):
    found = read_steps([shards], cache, 64)
    (path,) = shards.glob("*.h5")
    rows = read_shard(path).grasps
    steps, there = found.steps, rows.object_index[:, 1] >= 0
    two, one = np.flatnonzero(there), np.flatnonzero(~there)
    assert rows.sequence is not None
    np.testing.assert_array_equal(steps.q.numpy(), rows.q)
    np.testing.assert_array_equal(steps.used.numpy()[two], rows.sequence.free_joints[two, 0])
    np.testing.assert_array_equal(steps.used.numpy()[one], False)
    before = rows.sequence.q[two, 0]
    np.testing.assert_array_equal(steps.start.numpy()[two], before)  # frozen as before, the others as in the open hand
    open_posture = np.broadcast_to(inputs.hand.tree.joint_open, steps.start[one].shape)
    np.testing.assert_allclose(steps.start.numpy()[one], open_posture, atol=1e-6)
    assert (steps.held.numpy()[one] == -1).all()
    assert {found.object_names[i] for i in steps.object.numpy()[two]} == {"mug"}
    assert {found.object_names[i] for i in steps.held.numpy()[two, 0]} == {"sphere"}
    # a ball is about its own centre, which is where the contacts on it are a radius away
    radius = found.clouds[found.object_names.index("sphere")].norm(dim=1)
    torch.testing.assert_close(radius, radius.mean().expand_as(radius), atol=5e-4, rtol=0)
    T = pose_matrix(rows.object_pose[one, 0].astype(float))
    touched = np.einsum("nij,nj->ni", T[:, :3, :3], rows.contact_points[one, 0, 0]) + T[:, :3, 3]
    away = np.linalg.norm(touched - steps.t.numpy()[one], axis=1)
    np.testing.assert_allclose(away, float(radius.mean()), atol=2e-3)


def test_a_config_asks_for_a_training(shards, tmp_path):
    path = tmp_path / "job.yaml"
    path.write_text(f"job: diffuser\nshards: [{shards}]\nparams: {{steps: 7, process: flow}}\n")
    (asked,) = load_requests(str(path), {}).requests
    assert isinstance(asked, DiffuserRequest)
    assert (asked.params.steps, asked.params.process, asked.out.name) == (7, "flow", "diffuser.pt")


def test_training_learns_and_the_seed_decides(network, shards, cache, tmp_path):
    _, about = load_diffuser(network)
    assert about.report["loss"] < 0.95  # 1 of a network that knows nothing
    assert about.report["objects"] == ["mug", "sphere"]
    assert about.space_names[0] == "index-palm"
    params, weights = DiffuserParams.model_validate(TINY | {"steps": 5}), []
    for out in (tmp_path / "once.pt", tmp_path / "again.pt"):
        run(DiffuserJob(shards=(shards,), out=out, params=params, device="cpu", cache=cache))
        weights.append(load_diffuser(out)[0].state_dict())
    torch.testing.assert_close(*weights, atol=2e-3, rtol=0)


def test_valid_grasps_touch_where_draws_are_measured(network, shards, cache):
    """What tells how draws are in things finds nothing wrong with the rows of a shard."""
    found = evaluate(network, [shards], cache, device="cpu")
    assert found["of_data"]["touching"] == 1
    assert found["of_data"]["penetration_median"] < 0.6
    assert 0 <= found["touching"] < 1
    assert found["penetration_mean"] > found["of_data"]["penetration_mean"]
    assert found["draws"] == found["examples"]
    assert (found["unknown"], found["objects"]) == ([], ["mug", "sphere"])
    assert found["loss"] == pytest.approx(load_diffuser(network)[1].report["loss"], abs=0.05)


@pytest.fixture(scope="module")
def table(inputs):
    """Valid grasps of the first object."""
    return run_round(small_pipeline(), inputs, 0, 0, 2).levels[0]


def in_spaces(inputs, table, posture) -> Context:
    """Hands in some postures that hold nothing, each with the space of its row."""
    frozen, nothing = np.zeros(posture.shape, bool), np.zeros((len(table), 0, 7), np.float32)
    given = {"tries": 1, "spaces": inputs.spaces, "space": table.space[:, 0]}
    holding = hold(inputs.view.hand, posture, frozen, (), nothing, **given)
    bounds = small_pipeline().bounds
    return Context(inputs.view.hand, inputs.objects[0], inputs.view.field, "cpu", 0, 0, bounds, holding=holding)


def test_valid_grasps_as_predictions_mostly_stay(inputs, table):
    """Poses and joints of valid grasps: the stages find contacts there again, with the object hardly moved."""
    pipeline, view, rows = small_pipeline("sample"), inputs.view, len(table)
    posture = np.broadcast_to(inputs.hand.tree.joint_open.astype(np.float32), (rows, inputs.hand.dofs))
    context = in_spaces(inputs, table, posture)
    predicted = upload_predicted(view.hand, context.object, context.held, view.records, table.pose[:, 0], table.q[:, 0])
    grasps = run_stages(pipeline, context.changed(predicted=predicted), 0, rows, "filter")
    kept, first = np.unique(grasps.index, return_index=True)
    assert len(kept) > 0.35 * rows  # of candidates drawn by place one in fifty
    assert np.median(np.linalg.norm(grasps.pose[first, :3] - table.pose[kept, 0, :3], axis=1)) < 0.002


def test_valid_grasps_are_valid_as_they_are(inputs, table):
    """Poses and joints of valid grasps pass the filter unchanged, with the contacts that are found there."""
    pipeline, view = small_pipeline(), inputs.view
    pose, q, free = table.pose[:, 0], table.q[:, 0], table.free[:, 0]
    context = in_spaces(inputs, table, q)
    there = upload_predicted(view.hand, context.object, context.held, view.records, pose, q)
    grasps = TouchingGrasps(pose, q, *fetch([there.hand_point, there.object_point]))
    found = run_stage("filter", touching_sets(grasps, context), pipeline, context, Meter("cpu"))
    at = found.index
    np.testing.assert_array_equal(found.pose, pose[at])
    np.testing.assert_array_equal(found.q[free[at]], q[at][free[at]])
    assert len(found) > 0.8 * len(table)


def test_what_is_drawn_becomes_valid_shards(asked, network, tmp_path):
    pipeline = small_pipeline("sample", width=12, wave=8, waves=6, draws=4)
    job = SampleJob(**asked, rows=6, pipeline=pipeline, model=str(network), out=tmp_path / "out")
    outcome = run(job)
    (path,) = outcome.paths
    assert validate_shard(path) == []  # joints of earlier steps are bit by bit the same, among others
    with ShardReader(path) as reader:
        assert (reader.column("object_index")[:, 1] >= 0).sum() == 6
        assert job.pipeline.bounds.met_by({n: reader.column(f"metrics/{n}") for n in job.pipeline.bounds.limits}).all()
        assert reader.header.config["model"] == "net.pt"
    assert run(job.changed()).made == 0


def test_few_are_the_first_of_many(asked, network, tmp_path):
    """Bit by bit, though a network that multiplies other batches may round otherwise; whatever the threads."""
    pipeline = small_pipeline("sample", width=12, wave=8, waves=3, draws=4)
    given = asked | {"pipeline": pipeline, "model": str(network)}
    jobs = [SampleJob(**given, rows=n, workers=threads, out=tmp_path / str(n)) for n, threads in ((2, 1), (7, 3))]
    few, many = (run(job).paths for job in jobs)
    few, many = (read_shard(path).grasps for (path,) in (few, many))
    two, seven = (np.flatnonzero(rows.object_index[:, 1] >= 0) for rows in (few, many))
    assert len(two) == 2
    np.testing.assert_array_equal(few.q[two], many.q[seven[:2]])
    np.testing.assert_array_equal(few.object_pose[two], many.object_pose[seven[:2]])


@pytest.fixture
def clouds(inputs, tmp_path):
    """Points all over the two objects, one cloud in the file's own frame."""
    found = []
    for obj, name, shift in zip(inputs.objects, OBJECTS, (0.0, 0.2), strict=True):
        normals, _ = face_normals(obj.model.vertices, obj.model.faces)
        points, face = sample_surface(obj.model.vertices, obj.model.faces, 1500, seed=0)
        found.append(tmp_path / f"{name}.npz")
        np.savez(found[-1], points=points + shift, normals=normals[face])
    return tuple(found)


def test_objects_may_be_known_as_clouds(asked, network, clouds, monkeypatch, tmp_path):
    """Shards have the points as they were given; contacts are on them."""
    monkeypatch.setattr(model, "_MOST_NODES", 30_000)  # distances from clouds are exact enough
    pipeline = small_pipeline("sample", width=12, wave=8, waves=6, draws=4)
    given = {name: value for name, value in asked.items() if name not in ("objects", "scale")}
    job = SampleJob(**given, clouds=clouds, rows=2, pipeline=pipeline, model=str(network), out=tmp_path / "out")
    (path,) = run(job).paths
    assert path.name == f"allegro-{'-'.join(OBJECTS)}-00000.h5"
    assert validate_shard(path) == []
    shard = read_shard(path)
    rows = shard.grasps
    assert (rows.object_index[:, 1] >= 0).sum() == 2
    for number, record in enumerate(shard.objects):
        with np.load(clouds[OBJECTS.index(record.id)]) as file:
            np.testing.assert_allclose(record.vertices, file["points"], atol=1e-6)
            np.testing.assert_allclose(np.asarray(record.normals), file["normals"], atol=1e-6)
        assert not len(record.faces)
        touched = rows.contact_points[rows.object_index == number].reshape(-1, 3)
        touched = touched[np.isfinite(touched).all(1)]
        assert cdist(touched, record.vertices).min(1).max() < 0.003
    assert run(job.changed()).made == 0


def test_networks_of_other_hands_are_refused(asked, network, tmp_path):
    given = {"pipeline": small_pipeline("sample"), "model": str(network), "out": tmp_path / "out"}
    with pytest.raises(ConfigError, match=r"net.pt is of hand 'allegro', not of 'leap'"):
        run(SampleJob(**asked, **given, hand="leap"))

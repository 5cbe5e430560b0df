"""``lgrasp plan``."""

import json

import numpy as np
import pytest
import trimesh

from lgrasp.dataset.reader import read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.jobs.requests.plan import PlanRequest
from lgrasp.jobs.requests.search import SampleRequest

QUICK = ("--starts", 4, "--device", "cpu")


@pytest.fixture
def cloud(tmp_path):
    """A ball of 7 cm on a table, with labels, seen from above."""
    n = trimesh.creation.icosphere(subdivisions=3).vertices
    ball = 0.035 * n + [0, 0, 0.2]
    rng = np.random.default_rng(0)
    table = np.column_stack([rng.uniform(-0.2, 0.2, (500, 2)), np.zeros(500)])
    path = tmp_path / "scene.npz"
    labels = np.repeat([3, 0], [len(ball), len(table)])
    normals = np.concatenate([n, np.tile([0.0, 0, 1], (500, 1))])
    np.savez(path, points=np.concatenate([ball, table]), normals=normals, labels=labels)
    return path


def test_object(cli, tmp_path):
    found = cli("plan", "--object", "sphere", *QUICK, "--out", tmp_path / "out", "--json", "-")
    assert found.code == 0, found
    data = json.loads(found.out)
    assert data["grasps"] == data["counts"]["kept"] > 0
    (path,) = (tmp_path / "out" / name for name in data["shards"])
    assert validate_shard(path) == []
    shard = read_shard(path)
    assert shard.header.pipeline == "plan"
    assert shard.hand.name == "allegro"
    assert shard.header.config["stand_off"] == 0.12
    again = cli("plan", "--object", "sphere", *QUICK, "--out", tmp_path / "out", "--json", "-")
    assert json.loads(again.out)["present"] == data["grasps"]
    line = cli("plan", "--object", "sphere", *QUICK, "--stand-off", 0.1, "--out", tmp_path / "out").error()
    assert "--overwrite" in line


def test_the_hand_is_that_of_the_network(cli, monkeypatch):
    """Another is refused before anything is loaded."""
    assert PlanRequest(object="mug", model="grasp-shadow").hand == "shadow"
    monkeypatch.setattr(PlanRequest, "maker", "no.such:Job")
    line = cli("plan", "--object", "mug", "--model", "grasp-shadow", "--hand", "barrett").error()
    assert "grasp-shadow.pt is of hand 'shadow', not of 'barrett'" in line
    monkeypatch.setattr(SampleRequest, "maker", "no.such:Job")
    line = cli("sample", "seq-allegro", "mug", "sphere", "--hand", "shadow").error()
    assert "seq-allegro.pt is of hand 'allegro', not of 'shadow'" in line


def test_cloud_is_stored(cli, cloud, tmp_path):
    found = cli("plan", "--cloud", cloud, "--label", 3, *QUICK, "--out", tmp_path / "out")
    assert found.code == 0, found
    assert f"lgrasp render {tmp_path / 'out'}" in found.out  # no simulator takes points
    (path,) = (tmp_path / "out").glob("*.h5")
    assert validate_shard(path) == []
    shard = read_shard(path)
    (record,) = shard.objects
    assert len(record.faces) == 0
    radius = np.linalg.norm(record.vertices - [0, 0, 0.2], axis=1)
    np.testing.assert_allclose(radius, 0.035, atol=1e-3)
    assert record.normals is not None
    np.testing.assert_allclose(record.normals, (record.vertices - [0, 0, 0.2]) / radius[:, None], atol=1e-3)
    # contacts lie on the ball
    points = shard.grasps.contact_points.reshape(-1, 3)
    points = points[np.isfinite(points).all(1)]
    np.testing.assert_allclose(np.linalg.norm(points - [0, 0, 0.2], axis=1), 0.035, atol=2e-3)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "--object"),
        (["--object", "sphere", "--cloud", "a.ply"], "one of the two"),
        (["--object", "sphere", "--label", 1], "belong to --cloud"),
        (["--object", "sphere", "--starts", 0], "'starts' = 0: Input should be greater"),
        (["--object", "sphere", "--starts", -3], "'starts' = -3: Input should be greater"),
        (["--cloud", "none.ply"], "none.ply: does not exist"),
        (["--cloud", "."], "is a folder"),
        (["--object", "sphere", "--distal", -1], "'distal' = -1"),
        (["--object", "sphere", "--distal", "nan"], "'distal' = nan"),
        (["--object", "sphere", "--distal", 0, "--other", 0], "give one of them a weight"),
        (["--object", "sphere", "--stand-off", "nan"], "'stand_off' = nan: Input should be"),
        (["--object", "sphere", "--stand-off", 0], "'stand_off' = 0.0: Input should be greater than 0"),
        (["--object", "sphere", "--stand-off", 50], "'stand_off' = 50.0: Input should be less than or equal to 1"),
        (["--object", "sphere", "--model", "grasp-allegro", "--stand-off", 0.1], "a network draws its own"),
        (["--object", "sphere", "--hand", "baret"], "did you mean 'barrett'"),
        (["--object", "spere"], "did you mean sphere"),
        (["--object", "sphere", "--scale", 1000], "is accepted"),
        (["--object", "sphere", "--out", "/proc/nothing"], "cannot be written"),
        (["--object", "sphere", "--json", "/proc/nothing.json"], "cannot be written"),
    ],
)
def test_bad_input(cli, tmp_path, arguments, said):
    assert said in cli("plan", *arguments, "--device", "cpu").error()
    assert not list(tmp_path.iterdir())


def test_bad_viewpoint(cli, cloud):
    assert "give 3 numbers" in cli("plan", "--cloud", cloud, "--viewpoint", "1,2").error()
    assert "'nan,0,0': give 3 numbers" in cli("plan", "--cloud", cloud, "--viewpoint", "nan,0,0").error()

"""``lgrasp plan``."""

import json
import signal
import time

import numpy as np
import pytest
import trimesh

from lgrasp.dataset import read_shard, validate_shard

QUICK = ("--starts", 4, "--device", "cpu")


@pytest.fixture
def cloud(tmp_path):
    """A ball of 7 cm on a table, with labels, seen from above."""
    n = trimesh.creation.icosphere(subdivisions=4).vertices
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
    assert validate_shard(data["out"]) == []
    shard = read_shard(data["out"])
    assert shard.header.pipeline == "plan"
    assert shard.hand.name == "barrett"
    assert shard.header.config["stand_off"] == 0.15
    line = cli("plan", "--object", "sphere", *QUICK, "--out", tmp_path / "out").error()
    assert "--force" in line


def test_cloud_is_stored(cli, cloud, tmp_path):
    found = cli("plan", "--cloud", cloud, "--label", 3, *QUICK, "--out", tmp_path / "out")
    assert found.code == 0, found
    (path,) = (tmp_path / "out").glob("*.h5")
    assert validate_shard(path) == []
    shard = read_shard(path)
    (record,) = shard.objects
    assert len(record.faces) == 0
    radius = np.linalg.norm(record.vertices - [0, 0, 0.2], axis=1)
    np.testing.assert_allclose(radius, 0.035, atol=1e-3)
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
        (["--object", "sphere", "--starts", 0], "at least 1"),
        (["--cloud", "none.ply"], "does not exist"),
        (["--object", "sphere", "--distal", -1], "distal"),
    ],
)
def test_bad_input(cli, arguments, said):
    assert said in cli("plan", *arguments, "--device", "cpu").error()


def test_bad_viewpoint_and_label(cli, cloud):
    assert "three numbers" in cli("plan", "--cloud", cloud, "--viewpoint", "1,2").error()
    assert "its labels are 0" in cli("plan", "--cloud", cloud, "--label", 7).error()


def test_interrupted(process, tmp_path):
    """Ctrl-C ends with 130 and leaves no half file."""
    out = tmp_path / "out"
    with process("plan", "--object", "sphere", "--starts", 2000, "--device", "cpu", "--out", out) as run:
        time.sleep(5)
        run.send_signal(signal.SIGINT)
        assert run.wait(20) == 130
    assert not list(out.glob("*"))

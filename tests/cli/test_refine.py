"""``lgrasp refine``."""

import json

import numpy as np
import pytest

from lgrasp.dataset import read_shard, validate_shard


@pytest.fixture
def shards(generate, tmp_path):
    assert generate().code == 0
    return tmp_path / "out"


def test_shards(cli, shards, tmp_path):
    out = tmp_path / "refined"
    found = cli("refine", shards, "--out", out, "--device", "cpu", "--json", "-")
    assert found.code == 0, found
    (data,) = json.loads(found.out)
    (source,) = shards.glob("*.h5")
    before, after = read_shard(source).grasps, read_shard(out / source.name).grasps
    assert validate_shard(out / source.name) == []
    assert data["valid"] >= data["valid_before"]
    refined = after.metrics["refined"] == 1
    assert refined.sum() == data["refined"]
    np.testing.assert_array_equal(after.q[~refined], before.q[~refined])
    np.testing.assert_array_equal(after.candidate, before.candidate)
    terms = sum(
        after.metrics[f"energy_{name}"] for name in ("points", "normals", "force", "barrier", "overlap", "limits")
    )
    np.testing.assert_allclose(after.metrics["energy"], terms, rtol=1e-4)
    assert "--force" in cli("refine", shards, "--out", out, "--device", "cpu").error()


def test_every_row_is_moved_if_asked(cli, shards, tmp_path):
    out = tmp_path / "refined"
    assert cli("refine", shards, "--out", out, "--always", "--coarse", "--outer", 2, "--device", "cpu", "-q").code == 0
    (path,) = out.glob("*.h5")
    assert (read_shard(path).grasps.metrics["refined"] == 1).all()


def test_exports_of_other_programs(cli, shards, tmp_path):
    folder, out = tmp_path / "export", tmp_path / "refined"
    assert cli("export", shards, "--to", "dexgraspnet", "--out", folder).code == 0
    found = cli("refine", folder, "--from", "dexgraspnet", "--hand", "allegro", "--out", out, "--device", "cpu")
    assert found.code == 0, found
    (path,) = out.glob("*.h5")
    (source,) = shards.glob("*.h5")
    assert validate_shard(path) == []
    after, before = read_shard(path).grasps, read_shard(source).grasps
    kept = after.metrics["refined"] == 0
    np.testing.assert_allclose(after.q[kept], before.q[kept], atol=1e-5)
    assert "--hand" in cli("refine", folder, "--from", "dexgraspnet", "--out", tmp_path / "x").error()


def test_bad_input(cli, shards, tmp_path):
    assert "nothing" in cli("refine", "nothing", "--out", tmp_path / "x").error()
    assert "inner" in cli("refine", shards, "--out", tmp_path / "x", "--inner", 0).error()
    assert "another version" in cli("refine", shards, "--out", tmp_path / "x", "--hand", "barrett").error()

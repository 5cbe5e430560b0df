"""Verdicts of grasps that lgrasp generated."""

import shutil
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest

from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.run import run as generate
from lgrasp.errors import ShardError
from lgrasp.grasp.records import GraspRows
from lgrasp.jobs.generate import GenerateJob
from lgrasp.jobs.simulate import SimulateJob
from lgrasp.simulate.protocol import PROTOCOLS
from lgrasp.simulate.run import verdicts
from lgrasp.simulate.scene import Scene, scene_of
from lgrasp.simulate.verdict import Bounds

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

FC = PROTOCOLS["fc"]
ROWS = 12


@pytest.fixture(scope="module")
def path(swift, cache_root, tmp_path_factory) -> Path:
    """A shard of the shipped Allegro and ball."""
    out = tmp_path_factory.mktemp("ball")
    cache = Cache(cache_root, pytest.fail)
    job = GenerateJob(object="sphere", rows=ROWS, pipeline=swift, out=out, device="cpu", workers=1, cache=cache)
    return generate(job).paths[0]


def first(path: Path, count: int = ROWS) -> GraspRows:
    with ShardReader(path) as reader:
        return reader.rows(0, count)


@pytest.fixture(scope="module")
def scene(path: Path) -> Scene:
    shard = read_shard(path)
    return scene_of(shard.hand, shard.objects)


@pytest.fixture(scope="module")
def found(scene: Scene, path: Path) -> dict[str, np.ndarray]:
    return verdicts(scene, first(path), FC)


def test_most_hold_a_ball(found):
    assert found["fc_holds"].mean() > 0.5
    assert not found["fc_diverged"].any()
    assert (found["fc_contact_at_q"] >= 2).mean() > 0.9


def test_half_the_time_step_gives_the_same_verdicts(found, scene, path):
    fine = verdicts(scene, first(path), FC.model_copy(update={"timestep": FC.timestep / 2}))
    assert (fine["fc_holds"] == found["fc_holds"]).mean() >= 0.95


def test_ending_early_changes_no_verdict(found, scene, path, monkeypatch):
    monkeypatch.setattr(Bounds, "near", lambda *_: False)
    whole = verdicts(scene, first(path, 3), FC)
    assert (whole["fc_holds"] == found["fc_holds"][:3]).all()


def test_planted_failures(scene, path):
    """Nothing holds an object that is elsewhere, that is slippery, or with open fingers."""
    rows = first(path, 6)
    away = rows.object_pose + np.array([0.05, 0, 0, 0, 0, 0, 0], "f4")
    assert verdicts(scene, replace(rows, object_pose=away), FC)["fc_holds"].mean() < 0.2
    assert not verdicts(scene, replace(rows, q=rows.q_pregrasp, q_squeeze=rows.q_pregrasp), FC)["fc_holds"].any()
    slippery = FC.model_copy(update={"friction": 0.05})
    assert verdicts(scene, rows, slippery)["fc_holds"].mean() < 0.2


@pytest.mark.parametrize(("name", "value"), [("grasps/contact_links", 99), ("grasps/q", np.nan)])
def test_damaged_rows_are_refused(path, cache_root, tmp_path, name, value):
    spoilt = tmp_path / "spoilt.h5"
    shutil.copy(path, spoilt)
    with h5py.File(spoilt, "r+") as file:
        file[name][(3, *(0,) * (file[name].ndim - 1))] = value
    job = SimulateJob(shards=(spoilt,), out=tmp_path / "out", protocol=FC, device="cpu", cache=Cache(cache_root))
    with pytest.raises(ShardError, match=rf"spoilt\.h5: .*{name.partition('/')[2]}.*dataset check"):
        generate(job)
    assert not [*tmp_path.rglob("out/**/*.h5")]

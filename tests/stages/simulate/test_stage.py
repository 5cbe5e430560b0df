"""Keeps the grasps that hold, and their verdicts."""

import sys
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lgrasp.dataset.info import stage_counts
from lgrasp.dataset.reader import read_shard
from lgrasp.engine.batch import run_stages
from lgrasp.engine.cache import Cache
from lgrasp.engine.run import run as generate
from lgrasp.errors import ConfigError, OutputError, PhysicsError
from lgrasp.grasp.tables import GraspTable, grasp_arrays
from lgrasp.jobs.records import make_scene, mesh_blobs, object_record
from lgrasp.simulate.protocol import PROTOCOLS, find_protocol
from lgrasp.simulate.run import check_installed, verdicts
from lgrasp.simulate.scene import scene_of
from lgrasp.simulate.verdict import COLUMNS
from lgrasp.stages.context import Context
from lgrasp.stages.simulate.params import SimulateParams
from lgrasp.stages.simulate.stage import run

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


@pytest.fixture(scope="module")
def context(load, cache_root) -> Context:
    inputs = load("sphere")
    objects, meshes = [object_record(inputs.object.model)], mesh_blobs(inputs.keys.source.urdf)
    scene = make_scene(Cache(cache_root, pytest.fail), inputs.hand.model, objects, meshes)
    return Context(inputs.hand, inputs.object, inputs.field, "cpu", 0, 0, scene=scene)


@pytest.fixture(scope="module")
def grasps(swift, context) -> GraspTable:
    return run_stages(swift, context, 0, 16, "filter")


def test_keeps_what_holds(grasps, context):
    """Every second grasp is spoiled: its hand stays open. Those are dropped, the others stay as they were."""
    assert len(grasps) >= 8
    spoiled = np.arange(len(grasps)) % 2 == 1
    squeeze = np.where(spoiled[:, None], grasps.q_pregrasp, grasps.q_squeeze)
    q = np.where(spoiled[:, None], grasps.q_pregrasp, grasps.q)
    kept, counts = run(replace(grasps, q=q, q_squeeze=squeeze), SimulateParams(), context)
    assert counts["tried"] == len(grasps)
    assert 0 < counts["held"] == len(kept) <= (~spoiled).sum()
    assert set(kept.physics) == {f"fc_{name}" for name in COLUMNS}
    assert kept.physics["fc_holds"].all()
    assert kept.physics["fc_directions"].shape == (len(kept), 6)
    keys = list(zip(grasps.index[~spoiled], grasps.slot[~spoiled], strict=True))
    rows = [2 * keys.index(key) for key in zip(kept.index, kept.slot, strict=True)]
    assert rows == sorted(rows)
    for name, values in grasp_arrays(grasps).items():
        np.testing.assert_array_equal(values[rows], grasp_arrays(kept)[name], err_msg=name)


def test_no_grasps(grasps, context):
    none: dict[str, Any] = {
        name: values[:0] for name, values in grasp_arrays(grasps).items() if not name.startswith("metrics.")
    }
    kept, counts = run(GraspTable(**none, metrics={}, physics={}), SimulateParams(), context)
    assert len(kept) == counts["tried"] == 0
    assert kept.physics["fc_holds"].dtype == bool


def test_needs_a_scene_and_a_known_protocol(grasps, context, swift):
    with pytest.raises(PhysicsError, match="scene"):
        run(grasps, SimulateParams(), replace(context, scene=None))
    with pytest.raises(ConfigError, match="= 'fd': Input should be 'fc'"):
        swift.with_simulation("fd")


def test_generated_rows_hold(job, swift, tmp_path, raw_grasps):
    """The shard holds what simulating it again gives; batches and threads change nothing; its folder is its own."""
    checked = swift.with_params("search", per_pose=1, restarts=2).with_simulation("gravity6")
    kwargs = {"object": "sphere", "rows": 1, "shard_rows": 1, "batch": 2}
    outcome = generate(job(**kwargs, pipeline=checked))
    shard = read_shard(outcome.paths[0])
    physics = shard.grasps.physics
    assert physics["gravity6_holds"].all()
    assert len(shard.grasps) == 1
    again = verdicts(scene_of(shard.hand, shard.objects), shard.grasps, PROTOCOLS["gravity6"])
    for name, values in again.items():
        np.testing.assert_array_equal(physics[name], values, err_msg=name)
    tried, held = (int(shard.statistics[f"simulate_{name}"]) for name in ("tried", "held"))
    assert tried >= held >= 1
    other = generate(job(**kwargs | {"batch": 3, "workers": 2, "out": tmp_path / "other"}, pipeline=checked))
    assert raw_grasps(other.paths[0].parent) == raw_grasps(outcome.paths[0].parent)
    with pytest.raises(OutputError, match="another run"):
        generate(job(**kwargs))


def test_shards_of_0_1_name_the_stage_otherwise():
    assert stage_counts({"validate_tried": 5, "validate_held": 3, "simulate_tried": 2, "seconds_validate": 1.0}) == {
        "simulate": {"tried": 2, "held": 3}
    }


def test_simulates_where_the_job_runs(grasps, context, monkeypatch):
    """A GPU's job is simulated on that GPU, with what an earlier batch has left there."""
    asked = []

    def simulated(scene, rows, protocol, *, threads, device, keep):
        asked.append((device, keep("simulate", device, object)))
        return {f"{protocol.name}_{name}": np.zeros(len(rows)) for name in COLUMNS}

    monkeypatch.setattr("lgrasp.stages.simulate.stage.verdicts", simulated)
    there = replace(context, device="cuda:3")
    for _ in range(2):
        run(grasps, SimulateParams(), there)
    assert asked[0] == asked[1]
    assert asked[0][0] == "cuda:3"


def test_a_gpu_needs_a_simulator_of_its_own(monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco_warp", None)
    check_installed("cpu", find_protocol("fc"))
    with pytest.raises(PhysicsError, match="--device cpu"):
        check_installed("cuda:0", find_protocol("fc"))
    with pytest.raises(
        PhysicsError, match=r"fc_random has random draws.*--device cpu, or one of the protocols fc, gra"
    ):
        check_installed("cuda:0", find_protocol("fc_random"))

"""MuJoCo Warp judges as MuJoCo does."""

import os

import numpy as np
import pytest
import warp as wp
from reference.jaws import Jaws

from lgrasp.device.runtime import start
from lgrasp.physics import PROTOCOLS, scene_of_shard, verdicts
from lgrasp.physics.model import build_model

pytest.importorskip("mujoco_warp", reason="MuJoCo Warp is not installed (extra gpu-sim)")

start()
GPU = wp.get_cuda_device_count() > 0
pytestmark = pytest.mark.skipif(
    not GPU and not os.environ.get("LGRASP_TEST_WARP_CPU"),
    reason="no GPU; LGRASP_TEST_WARP_CPU=1 takes Warp's CPU device, which compiles for minutes",
)
FC = PROTOCOLS["fc"]


@pytest.fixture
def six(jaws: Jaws):
    """A scene and six grasps; the first presses too little, the last ones hold."""
    shard = jaws.shard(0.002, count=6)
    depth = np.linspace(0.0002, 0.004, 6, dtype="f4")[:, None]
    return scene_of_shard(shard), Jaws.rows(shard, q_squeeze=shard.grasps.q - depth)


def judge(scene, rows, worlds: int = 8):
    from lgrasp.physics.gpu import WorldTrials

    model = build_model(scene, FC, rows.q[0])
    return WorldTrials(model, "cuda:0" if GPU else "cpu", worlds=worlds, all_directions=True).run(rows)


def test_same_verdicts(six):
    """In as many worlds as there are grasps, and in fewer."""
    here = verdicts(*six, FC, all_directions=True)
    assert 0 < here["fc_holds"].sum() < 6
    for worlds in (8, 4):
        there = judge(*six, worlds=worlds)
        for name in ("holds", "directions", "contact_at_q", "settled", "diverged"):
            np.testing.assert_array_equal(here[f"fc_{name}"], there[f"fc_{name}"], err_msg=name)
        for name, bound in (("displacement", 2e-3), ("slip", 2e-4), ("pregrasp_penetration", 1e-6)):
            np.testing.assert_allclose(here[f"fc_{name}"], there[f"fc_{name}"], atol=bound, err_msg=name)


def test_a_world_without_room_is_judged_by_mujoco(six, monkeypatch):
    """Rows that need more constraints than there is room for get MuJoCo's own verdict."""
    from lgrasp.physics import worlds

    monkeypatch.setattr(worlds, "_CONSTRAINTS", 8)
    here, there = verdicts(*six, FC, all_directions=True), judge(*six)
    for name, values in here.items():
        np.testing.assert_array_equal(values, there[name], err_msg=name)

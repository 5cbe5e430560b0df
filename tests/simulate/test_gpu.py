"""MuJoCo Warp judges as MuJoCo does."""

import os
from dataclasses import replace

import numpy as np
import pytest
import warp as wp
from support.jaws import Jaws
from support.twins import in_one_gripper, twin_rows, twin_shard

from lgrasp.runtime.device import start
from lgrasp.simulate.model import build_model
from lgrasp.simulate.protocol import PROTOCOLS
from lgrasp.simulate.run import group_rows, load_world_kernels, verdicts
from lgrasp.simulate.scene import scene_of
from lgrasp.simulate.verdict import stack_verdicts

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
    return scene_of(shard.hand, shard.objects), Jaws.rows(shard, q_squeeze=shard.grasps.q - depth)


def judge(scene, rows, worlds: int = 8, protocol=FC, all_directions: bool = True):
    from lgrasp.simulate.gpu import WorldTrials

    (group,) = group_rows(rows, scene.objects)
    model = build_model(scene, protocol, rows.q[0], group.objects)
    trials = WorldTrials(model, "cuda:0" if GPU else "cpu", worlds=worlds, all_directions=all_directions)
    return stack_verdicts(protocol, trials.run(group.rows), group.slots)


def test_same_verdicts(six):
    """In as many worlds as there are grasps, and in fewer."""
    here = verdicts(*six, protocol=FC, all_directions=True)
    assert 0 < here["fc_holds"].sum() < 6
    for worlds in (8, 4):
        there = judge(*six, worlds=worlds)
        for name in ("holds", "directions", "contact_at_q", "settled", "diverged"):
            np.testing.assert_array_equal(here[f"fc_{name}"], there[f"fc_{name}"], err_msg=name)
        for name, bound in (("displacement", 2e-3), ("slip", 2e-4), ("pregrasp_penetration", 1e-6)):
            np.testing.assert_allclose(here[f"fc_{name}"], there[f"fc_{name}"], atol=bound, err_msg=name)


def test_directions_end_with_the_first_that_is_lost(six):
    """All of them are pulled at once, but the columns are those of one after the other."""
    here, there = verdicts(*six, protocol=FC), judge(*six, all_directions=False)
    assert (here["fc_directions"] == -1).any()
    for name in ("directions", "holds", "diverged"):
        np.testing.assert_array_equal(here[f"fc_{name}"], there[f"fc_{name}"], err_msg=name)
    np.testing.assert_array_equal(np.isnan(here["fc_displacement"]), np.isnan(there["fc_displacement"]))


def test_kernels_do_not_depend_on_how_objects_are_cut(jaws: Jaws, monkeypatch):
    """Those compiled while a cube is cut are all that four cubes in its place need."""
    from lgrasp.simulate.gpu import WorldTrials

    shard, device = jaws.shard(0.002, count=1), "cuda:0" if GPU else "cpu"
    load_world_kernels(shard.hand, shard.objects, shard.grasps, FC, device)
    scene = scene_of(shard.hand, shard.objects)
    (group,) = group_rows(shard.grasps, scene.objects)
    quarters = tuple(
        scene.objects[0].pieces[0] * [1, 0.5, 0.5] + [0, y, z] for y in (-0.01, 0.01) for z in (-0.01, 0.01)
    )
    cut = replace(scene, objects=(replace(scene.objects[0], pieces=quarters),))
    load, loaded = wp.Module.load, []

    def counted(self, *args, **options):
        before = len(self.execs)
        found = load(self, *args, **options)
        if len(self.execs) > before:
            loaded.append(self.name)
        return found

    monkeypatch.setattr(wp.Module, "load", counted)
    WorldTrials(build_model(cut, FC, shard.grasps.q[0], group.objects), device, worlds=2)
    assert loaded == []


def test_hands_at_once():
    """As many as there are rows, within bounds and half the memory."""
    from lgrasp.simulate.gpu import hands_at_once

    assert hands_at_once(4000, 1, 1e12) == 4000
    assert hands_at_once(10, 1, 1e12) == 256
    assert hands_at_once(100_000, 1, 1e12) == 8192
    assert hands_at_once(8192, 2, 16e9) < hands_at_once(8192, 1, 16e9) < 8192


def test_a_world_without_room_is_judged_by_mujoco(six, monkeypatch):
    """Rows that need more constraints than there is room for get MuJoCo's own verdict."""
    from lgrasp.simulate import worlds

    monkeypatch.setattr(worlds, "_CONSTRAINTS_PER_OBJECT", 8)
    here, there = verdicts(*six, protocol=FC, all_directions=True), judge(*six)
    for name, values in here.items():
        np.testing.assert_array_equal(values, there[name], err_msg=name)


@pytest.mark.parametrize("name", ["seq6", "gravity6"])
def test_two_objects(name: str):
    """Held in a gripper each, one let go, one inside the other, both in one gripper."""
    protocol, rows = PROTOCOLS[name], twin_rows(count=4)
    squeeze, q, start, pose = rows.q_squeeze.copy(), rows.q.copy(), rows.q_pregrasp.copy(), rows.object_pose.copy()
    pose[1, 1, 2] += 0.3
    pose[2, 0] = pose[2, 1]
    pose[2, 0, 0] += 0.02
    one = in_one_gripper(0.004)
    squeeze[3], q[3], start[3], pose[3] = one.q_squeeze[0], one.q[0], one.q_pregrasp[0], one.object_pose[0]
    rows = replace(rows, q=q, q_squeeze=squeeze, q_pregrasp=start, object_pose=pose)
    shard = twin_shard(rows)
    scene = scene_of(shard.hand, shard.objects)
    here, there = verdicts(scene, rows, protocol, all_directions=True), judge(scene, rows, protocol=protocol)
    assert here[f"{name}_holds"].tolist() == [True, False, False, True]
    for column in ("holds", "directions", "stays", "object_touches", "settled", "diverged", "contact_at_q"):
        np.testing.assert_array_equal(here[f"{name}_{column}"], there[f"{name}_{column}"], err_msg=column)
    # objects bounce on each other for a few steps: another solver, or half the time step, does not repeat that
    for column, bound in (("object_displacement", 2e-3), ("penetration", 1.5e-3), ("slip", 2e-4)):
        kept = [0, 3]
        np.testing.assert_allclose(
            here[f"{name}_{column}"][kept], there[f"{name}_{column}"][kept], atol=bound, err_msg=column
        )

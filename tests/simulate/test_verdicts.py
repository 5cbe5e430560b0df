"""Verdicts against what statics says, planted failures, and what must not matter."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.jaws import EDGE, Jaws
from support.judging import judge

from lgrasp.errors import ConfigError, PhysicsError
from lgrasp.simulate.model import build_model
from lgrasp.simulate.mujoco_world import MujocoWorld
from lgrasp.simulate.protocol import PROTOCOLS, find_protocol
from lgrasp.simulate.run import protocol_text
from lgrasp.simulate.scene import scene_of
from lgrasp.simulate.trial import Trial
from lgrasp.simulate.verdict import Closed, Pulls, moved

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

FC = PROTOCOLS["fc"]
SLIDING = FC.stiffness / FC.lever**2  # [N/m] of a jaw


@pytest.fixture
def fc(engine):
    """The protocol fc in each simulator."""
    return FC.by(engine)


def press(force: float) -> float:
    """Squeeze [m] with which each jaw presses with some force [N]."""
    return force / SLIDING


@pytest.mark.parametrize("normal", [0.6, 1.1])
def test_friction_of_two_jaws(jaws: Jaws, fc, normal: float):
    """Each jaw bears mu x N: the cube stays under 1 N when 2 x 0.6 x N > 1; against jaws and palm it always does."""
    found = judge(jaws.shard(press(normal)), fc, all_directions=True)
    holds = 2 * FC.friction * normal > FC.force
    assert found["holds"] == [holds]
    np.testing.assert_array_equal(found["directions"][0], [1, 1, *[int(holds)] * 3, 1])
    assert found["contact_at_q"] == 2
    # against a jaw: the cube gives way by force / stiffness of both jaws, and swings as far again at most
    give = found["displacement"][0, :2] * (2 * SLIDING) / FC.force
    assert ((give > 0.98) & (give < 2.3)).all()


@pytest.mark.parametrize("effort", [0.6, 1.1])
def test_jaws_press_no_harder_than_their_effort(jaws: Jaws, fc, effort: float):
    """Targets that ask for 4 N of each jaw: the URDF's effort limit [N] decides, as the normal force above."""
    shard = jaws.shard()
    weak = shard.hand.urdf.replace('effort="100"', f'effort="{effort}"')
    found = judge(jaws.shard(press(4.0), urdf=weak), fc)
    assert found["holds"] == [2 * FC.friction * effort > FC.force]


def test_stops_at_the_first_loss(jaws: Jaws):
    found = judge(jaws.shard(press(0.5)), FC)
    np.testing.assert_array_equal(found["directions"][0], [1, 1, 0, -1, -1, -1])
    assert np.isnan(found["displacement"][0, 3:]).all()
    assert found["displacement"][0, 2] > FC.most_displacement
    assert not found["diverged"].any()


def test_planted_failures(jaws: Jaws, fc):
    good = jaws.shard(press(4.0))
    assert judge(good, fc)["holds"].all()
    away = good.grasps.object_pose.copy()
    away[..., 1] += 0.05
    assert not judge(good, fc, rows=Jaws.rows(good, object_pose=away))["holds"].any()
    slippery = judge(good, fc.model_copy(update={"friction": 0.05}))
    assert not slippery["holds"].any()
    opened = good.grasps.q_pregrasp
    unclosed = judge(good, fc, rows=Jaws.rows(good, q=opened, q_squeeze=opened))
    assert not unclosed["holds"].any()
    assert unclosed["contact_at_q"] == unclosed["contact_at_grasp"] == 0
    inside = Jaws.rows(good, q_pregrasp=np.full_like(opened, EDGE / 2 - 0.012))
    deep = judge(good, fc, rows=inside)
    assert deep["pregrasp_penetration"] == pytest.approx(0.012, abs=2e-4)
    assert not deep["holds"].any()
    assert (deep["directions"] == -1).all()


def test_contact_and_slip(jaws: Jaws):
    """At q the jaws just touch; a jaw that closes alone pushes the cube, and its contact slides nowhere."""
    good = jaws.shard(press(4.0))
    found = judge(good, FC)
    assert found["contact_at_q"] == 2
    assert found["slip"] < 1e-3
    shifted = good.grasps.object_pose.copy()
    shifted[..., 1] += 0.006  # contacts are where q puts the links, 6 mm beside where they were meant to be
    q = good.grasps.q + np.float32(0.002)
    assert judge(good, FC, rows=Jaws.rows(good, q=q))["contact_at_q"] == 0  # 2 mm off
    assert judge(good, FC, rows=Jaws.rows(good, q=q))["slip"] == pytest.approx(0.0025, abs=1e-3)
    assert judge(good, FC, rows=Jaws.rows(good, object_pose=shifted))["slip"] < 1e-3


def test_rows_stand_alone(jaws: Jaws, fc):
    """Neither the number of threads or processes nor the other rows decide a verdict."""
    shard = jaws.shard(press(1.0), count=3)
    depth = np.linspace(0.5, 3.0, 3, dtype="f4")[:, None]
    rows = Jaws.rows(shard, q_squeeze=shard.grasps.q - np.float32(press(1.0)) * depth)
    one, two = (judge(shard, fc, rows=rows, threads=n) for n in (1, 2))
    assert 0 < one["holds"].sum() < 3
    last = {name: values[-1:] for name, values in rows.columns().items()}
    single = judge(shard, fc, rows=replace(rows, **last))
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name], err_msg=name)
        np.testing.assert_array_equal(values[-1:], single[name], err_msg=name)


def test_frame_of_the_object_does_not_matter(jaws: Jaws, fc):
    shard = jaws.shard(press(2.0))
    shift = np.array([30.0, -20.0, 10.0], "f4")  # as of scans in the coordinates of a room
    cube = shard.objects[0]
    moved = replace(shard, objects=[replace(cube, vertices=cube.vertices + shift)])
    pose = shard.grasps.object_pose.copy()
    pose[..., :3] -= shift
    rows = Jaws.rows(shard, object_pose=pose, contact_points=shard.grasps.contact_points + shift)
    a, b = judge(shard, fc, all_directions=True), judge(moved, fc, rows=rows, all_directions=True)
    np.testing.assert_array_equal(a["directions"], b["directions"])
    for name in ("displacement", "slip", "pregrasp_penetration"):
        atol = 1e-3 if fc.engine == "physx" else 2e-4  # PhysX has single precision, and creeps
        np.testing.assert_allclose(a[name], b[name], atol=atol, err_msg=name)


def test_weight_of_an_object(jaws: Jaws):
    """gravity6: 0.5 g/cm3 x 64 cm3 = 32 g, which pull with 0.31 N."""
    protocol = PROTOCOLS["gravity6"]
    load = protocol.load(EDGE**3)
    assert load.mass == pytest.approx(0.032)
    assert load.force == pytest.approx(0.3136)
    assert load.stiffness == 5.0
    assert protocol.load(10 * EDGE**3).stiffness == pytest.approx(5 * 3.136)
    assert protocol.load(100 * EDGE**3).stiffness == 100.0
    for normal, holds in ((0.2, False), (0.35, True)):  # 2 x 0.6 x N against 0.31 N
        assert judge(jaws.shard(press(normal)), protocol)["holds"] == [holds]


def test_a_direction_can_be_ended_by_another(jaws: Jaws):
    """The object goes as far as where it all runs in one simulation."""
    shard = jaws.shard(0.002)
    model = build_model(scene_of(shard.hand, shard.objects), PROTOCOLS["fc"], shard.grasps.q[0])
    pose, here = shard.grasps.object_pose[0], MujocoWorld(model)
    here.begin(shard.grasps.q[0], pose)
    home, load = here.objects().copy(), np.tile([0.0, 0.0, 1.0], (12, 1))
    here.drive(model.controls(shard.grasps.q_squeeze[0].astype(float)))
    here.push(model.forces[:, None] * load[0])
    here.step(20)
    begun = [a.copy() for a in (here.data.qpos, here.data.qvel, here.data.qacc_warmstart, here.data.ctrl)]
    here.step(len(load))
    pulls, so_far = Pulls.of(1), Closed(0, np.nan, False, np.zeros((1, 2)), 0.0)
    diverged = Trial(model).go_on(begun, home, load, pulls, 4, so_far)
    assert not diverged
    assert pulls.held.tolist() == [-1] * 4 + [1, -1]
    np.testing.assert_allclose(pulls.moved[4], moved(here.objects(), home), atol=1e-9)


def test_divergence_is_a_failure_and_writes_nothing(jaws: Jaws, fc, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found = judge(jaws.shard(press(4.0)), fc.model_copy(update={"force": 1.0e12}))
    assert found["diverged"].all()
    assert not found["holds"].any()
    assert not list(tmp_path.iterdir())


def test_progress_can_end_it(jaws: Jaws):
    def stop(done: int, held: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        judge(jaws.shard(press(1.0), count=50), FC, progress=stop)


def test_no_rows(jaws: Jaws):
    shard = jaws.shard(count=0)
    found = judge(shard, FC)
    assert found["directions"].shape == (0, 6)


def test_protocol_text_names_every_number(jaws: Jaws):
    shard = jaws.shard()
    text = json.loads(protocol_text(scene_of(shard.hand, shard.objects), FC))
    assert text["name"] == "fc"
    for name, value in FC.model_dump(mode="json").items():
        assert text[name] == value
    (cube,) = text["objects"]
    assert (cube["name"], cube["mass"], cube["force"], cube["stiffness"]) == ("cube", 0.1, 1.0, 5.0)
    assert text["simulator"].startswith("mujoco ")


def test_errors(jaws: Jaws, monkeypatch):
    with pytest.raises(ConfigError, match="unknown protocol 'fd'; choose fc, gravity6"):
        find_protocol("fd")
    shard = jaws.shard()
    for index, said in ((-1, r"row 1 has object_index \[-1\]"), (1, r"\[1\]; one object at least, of 1 that there")):
        with pytest.raises(PhysicsError, match=said):
            judge(shard, FC, rows=jaws.rows(jaws.shard(count=2), object_index=np.array([[0], [index]])))
    heavy = shard.hand.urdf.replace("</link>", '<inertial><mass value="-1"/></inertial></link>', 1)
    with pytest.raises(PhysicsError, match="MuJoCo refuses hand 'jaws'"):
        judge(jaws.shard(urdf=heavy), FC)
    monkeypatch.setitem(__import__("sys").modules, "mujoco", None)
    with pytest.raises(PhysicsError, match=r'pip install "lgrasp\[sim\]"'):
        judge(shard, FC)

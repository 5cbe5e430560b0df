"""Protocol seq_shake: what is pressed firmly stays, what is not falls when statics says so; gravity turns."""

import json
from itertools import pairwise

import numpy as np
import pytest
from support.jaws import EDGE, Jaws
from support.judging import judge
from support.twins import twin_rows, twin_shard

from lgrasp.choices import EngineName
from lgrasp.config import parse_model
from lgrasp.errors import ConfigError, PhysicsError
from lgrasp.simulate.lift import shake_course
from lgrasp.simulate.protocol import GRAVITY, PROTOCOLS, Draws, Protocol, Shake
from lgrasp.simulate.run import protocol_text
from lgrasp.simulate.scene import scene_of
from lgrasp.simulate.verdict import AXES

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

SHAKE = PROTOCOLS["seq_shake"]
WEIGHT = 500 * EDGE**3 * 9.8  # [N] of a cube
SLIDING = 500.0  # [N/m] of a jaw
TURNS = [0, 2, 4, 1, 3, 5]  # +x, +y, +z, -x, -y, -z: the order in which gravity has them


def shaken(engine: EngineName, press: float, acceleration: float = 13.0, **numbers: float):
    """Two cubes, each between jaws that press with some force over its weight."""
    changes = {"shake": Shake(acceleration=acceleration), **numbers}
    shard = twin_shard(twin_rows(press * WEIGHT / SLIDING))
    return judge(shard, SHAKE.by(engine).model_copy(update=changes))


def test_two_that_are_pressed_firmly_stay(engine):
    """Jaws bear 2 mu N = 16 W; the shaking takes at most 1 + 13 / 9.8 of it."""
    found = shaken(engine, 4.0)
    assert found["holds"].all()
    assert found["stays"].all()
    assert (found["directions"] == 1).all()
    assert found["object_touches"].tolist() == [[1, 1]]
    assert 0 < found["object_displacement"].max() < 2e-3


def test_shaking_loses_what_only_bears_its_weight(engine):
    """Jaws that bear 2 x 0.6 x 1.5 = 1.8 W hold it still in every direction, and not shaken with 60 m/s^2."""
    still, rough = (shaken(engine, 1.5, acceleration, friction=0.6) for acceleration in (0.0, 60.0))
    assert still["holds"].all()
    assert not rough["holds"].any()
    assert rough["directions"][0, 0] == 0
    assert (rough["directions"][0, TURNS[1:]] == -1).all()
    assert not rough["diverged"].any()


def test_gravity_is_turned(engine):
    """Between slippery jaws cubes stay while gravity is along the jaws' way, +x, and fall with the turn to +y."""
    found = shaken(engine, 4.0, 0.0, friction=0.02)
    assert found["directions"][0, TURNS].tolist() == [1, 0, -1, -1, -1, -1]
    assert not found["holds"].any()


def test_where_gravity_points():
    """Of its own strength but while the hand is shaken, each direction at a right angle to the one before."""
    course, dt = shake_course(SHAKE), SHAKE.timestep
    assert list(course) == TURNS
    hold, turn = (round(seconds / dt) for seconds in (SHAKE.hold, Shake().turning))
    for before, k in pairwise(TURNS):
        assert AXES[before] @ AXES[k] == 0
        assert len(course[k]) == turn + hold
        np.testing.assert_allclose(np.linalg.norm(course[k], axis=1), 1.0)
        np.testing.assert_allclose(course[k][turn - 1 :], np.tile(AXES[k], (hold + 1, 1)), atol=1e-12)
        angle = np.degrees(np.arccos(np.clip(course[k][:turn] @ AXES[before], -1, 1)))
        assert angle[0] < 0.1
        assert angle[turn // 2 - 1] == pytest.approx(45, abs=0.1)
        assert (np.diff(angle) > 0).all()
    push = GRAVITY * np.linalg.norm(AXES[0] - course[0][:-hold], axis=1)
    assert push.max() == pytest.approx(13.0)
    assert len(push) == round(2.0 / dt)
    assert np.linalg.matrix_rank(AXES[0] - course[0][:-hold], tol=1.0) == 3


def test_rows_stand_alone_and_their_text_says_all():
    """Neither the number of threads nor the other rows decide a verdict, and all numbers are stored."""
    shard = twin_shard(twin_rows(4 * WEIGHT / SLIDING, count=2))
    one, two = (judge(shard, SHAKE, threads=n) for n in (1, 2))
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name], err_msg=name)
        np.testing.assert_array_equal(values[:1], values[1:], err_msg=name)
    text = json.loads(protocol_text(scene_of(shard.hand, shard.objects), SHAKE))
    assert Protocol.model_validate({name: text[name] for name in Protocol.model_fields}) == SHAKE


def test_what_it_refuses(jaws: Jaws):
    with pytest.raises(PhysicsError, match="seq_shake shakes the hand, which runs on the CPU alone: give --device cpu"):
        judge(jaws.shard(), SHAKE, device="cuda:0")
    for wrong in ({"kind": "force"}, {"draws": Draws().model_dump()}):
        with pytest.raises(ConfigError, match="kind"):
            parse_model(Protocol, SHAKE.model_dump() | wrong, "protocol")

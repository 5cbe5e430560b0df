"""Protocols lift and dipgrasp: a cube is taken up by two jaws, or is not, for the reason that statics names."""

import json
from dataclasses import replace

import numpy as np
import pytest
from support.jaws import EDGE, Jaws
from support.judging import judge
from support.twins import twin_rows, twin_shard

from lgrasp.config import parse_model
from lgrasp.errors import ConfigError, PhysicsError
from lgrasp.geometry.poses import rotated
from lgrasp.simulate.lift import course_of
from lgrasp.simulate.protocol import PROTOCOLS, FreeLift, Lift, Protocol
from lgrasp.simulate.run import protocol_text
from lgrasp.simulate.scene import scene_of

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

LIFT, FREE = PROTOCOLS["lift"], PROTOCOLS["dipgrasp"]
SLIDING = LIFT.stiffness / LIFT.lever**2  # [N/m] of a jaw
ABOVE = 0.078  # of the cube over the hand's base [m]: the jaws' tips end 3 mm above the table
DOWN, UP = np.array([0, 0, 1.0]), np.array([0, 0, -1.0])  # the jaws point along +z of the hand, to the table


@pytest.fixture
def lift(engine):
    return LIFT.by(engine)


@pytest.fixture
def free(engine):
    return FREE.by(engine)


def standing(jaws: Jaws, press: float, *, approach: np.ndarray = DOWN, count: int = 1):
    """The jaws around a cube that stands on a table, each to press with some force [N]."""
    shard = jaws.shard(press / SLIDING, count=count)
    plane = np.array([[0, 0, 1, -EDGE / 2, 0.5], [*UP, -EDGE / 2, 0.5]], "f4")
    table = {"pose": np.ones(count, "i4"), "approach": np.tile(approach.astype("f4"), (count, 1))}
    cube = replace(shard.objects[0], tables=plane)
    pose = shard.grasps.object_pose.copy()
    pose[..., 2] = ABOVE
    return replace(shard, objects=[cube], grasps=replace(shard.grasps, object_pose=pose, table=table))


def below(jaws: Jaws, press: float, count: int = 1):
    """The jaws around a cube whose +z is away from where they point: they take it up from above."""
    shard = jaws.shard(press / SLIDING, count=count)
    pose = shard.grasps.object_pose.copy()
    pose[..., 3:] = [0, 1, 0, 0]
    return replace(shard, grasps=replace(shard.grasps, object_pose=pose))


def test_lifts_what_friction_bears(jaws: Jaws, lift):
    """Two jaws of 4 N bear 2 mu 4 N against 0.98 N: 4.8 N with friction 0.6, 0.4 N with 0.05."""
    good = judge(standing(jaws, 4.0), lift)
    assert good["holds"] == [True]
    assert good["displacement"] < 3e-3
    assert good["rotation"] < np.radians(2.0)
    assert good["pushed"] < 1e-3
    assert good["contact_at_q"] == 2
    assert not good["on_table"].any()
    slippery = judge(standing(jaws, 4.0), lift.model_copy(update={"friction": 0.05}))
    assert slippery["holds"] == [False]
    assert slippery["displacement"] > LIFT.most_displacement
    assert slippery["on_table"].all()
    assert not slippery["diverged"].any()


def test_frame_of_the_object_does_not_matter(jaws: Jaws, lift):
    shift, near = np.array([30.0, -20.0, 10.0], "f4"), standing(jaws, 4.0)
    cube, pose = near.objects[0], near.grasps.object_pose.copy()
    planes = cube.tables + np.float32([[0, 0, 0, 1, 0]]) * (cube.tables[:, :3] @ shift)[:, None]
    pose[..., :3] -= rotated(pose[..., 3:], shift)
    rows = replace(near.grasps, object_pose=pose, contact_points=near.grasps.contact_points + shift)
    far = replace(near, objects=[replace(cube, vertices=cube.vertices + shift, tables=planes)], grasps=rows)
    a, b = judge(near, lift), judge(far, lift)
    assert a["holds"] == b["holds"] == [True]
    for name in ("displacement", "pushed", "pregrasp_penetration"):
        np.testing.assert_allclose(a[name], b[name], atol=1e-3, err_msg=name)


def test_shaking_counts(jaws: Jaws, lift):
    """Jaws that bear the weight but not 0.1 kg at 40 m/s^2 lose the cube."""
    rough = lift.model_copy(update={"lift": Lift(shake=40.0)})
    assert judge(standing(jaws, 1.5), lift)["holds"] == [True]
    assert judge(standing(jaws, 1.5), rough)["holds"] == [False]


def test_a_hand_that_comes_through_the_object_moves_it(jaws: Jaws, lift):
    """A jaw that comes from the side pushes the cube over the table."""
    found = judge(standing(jaws, 4.0, approach=np.array([1.0, 0, 0])), lift)
    assert found["pushed"] > 0.01


def test_a_hand_that_closes_above_the_object_lifts_nothing(jaws: Jaws, lift):
    """Jaws that close over a cube which is still below them."""
    shard = standing(jaws, 4.0)
    pose = shard.grasps.object_pose.copy()
    pose[..., 2] += 0.06
    found = judge(shard, lift, rows=Jaws.rows(shard, object_pose=pose))
    assert found["holds"] == [False]
    assert found["on_table"].all()
    assert found["pushed"] < 1e-3


def test_rows_stand_alone(jaws: Jaws):
    """Neither the number of threads nor the other rows decide a verdict."""
    shard = standing(jaws, 1.0, count=3)
    depth = np.array([[0.3], [4.0], [2.0]], "f4") / np.float32(SLIDING)
    approach = np.array([[0, 0, 1], [0, 0, 1], [0, 0.6, 0.8]], "f4")
    table = dict(shard.grasps.table) | {"approach": approach}
    rows = replace(shard.grasps, q_squeeze=shard.grasps.q - depth, table=table)
    one, two = (judge(shard, LIFT, rows=rows, threads=n) for n in (1, 2))
    assert one["holds"].tolist() == [False, True, True]
    columns = {name: values[-1:] for name, values in rows.columns().items() if "/" not in name}
    last = replace(rows, **columns, table={name: values[-1:] for name, values in table.items()})
    single = judge(shard, LIFT, rows=last)
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name], err_msg=name)
        np.testing.assert_array_equal(values[-1:], single[name], err_msg=name)


def test_where_the_hand_is():
    """15 cm back, at the grasp, 15 cm up; it rests between, and its acceleration in the hold is 2 m/s^2 at most."""
    up, approach = np.array([0, 0.6, 0.8]), np.array([0, -1.0, 0])
    course = course_of(LIFT, [np.zeros(1), np.ones(1), np.full(1, 3.0)], up, approach)
    dt, seconds = LIFT.timestep, 2 * LIFT.phase + LIFT.rest
    np.testing.assert_allclose(course.way[0], -0.15 * approach)
    assert course.rises - course.closes == pytest.approx(seconds / dt, abs=2)
    np.testing.assert_allclose(course.way[course.closes : course.rises + 1], 0.0, atol=1e-12)
    assert LIFT.table
    risen = course.rises + round(LIFT.table.rising / dt)
    np.testing.assert_allclose(course.way[risen], 0.15 * up)
    push = np.diff(course.way[risen - 1 :], 2, axis=0) / dt**2
    assert np.linalg.norm(push[2:], axis=1).max() == pytest.approx(2.0, rel=1e-3)
    np.testing.assert_allclose(push[2:] @ up, 0.0, atol=1e-9)
    first, second = np.array_split(push[2:-2], 2)
    assert np.linalg.matrix_rank(push, tol=0.1) == 2
    assert abs(first[50:90].mean(0) @ second[50:90].mean(0)) < 0.05  # one axis, then the other
    np.testing.assert_array_equal(course.targets[[0, course.closes - 1, -1], 0], [0.0, 0.0, 3.0])
    assert len(course.targets) == len(course.way) - 1


def test_stored_text_says_all(jaws: Jaws, lift):
    shard = standing(jaws, 1.0)
    text = json.loads(protocol_text(scene_of(shard.hand, shard.objects), lift))
    assert text["lift"] == {"coming": 1, "way": 0.15, "rising": 1, "height": 0.15, "shake": 2, "frequency": 2}
    assert text["objects"][0]["mass"] * 9.81 == pytest.approx(text["objects"][0]["force"])
    assert Protocol.model_validate({name: text[name] for name in Protocol.model_fields}) == lift


def test_bad_input(jaws: Jaws):
    with pytest.raises(PhysicsError, match="do not say how the object lies on a table; lgrasp generate --table makes"):
        judge(jaws.shard(), LIFT)
    shard = standing(jaws, 1.0)
    bad = replace(shard.grasps, table=dict(shard.grasps.table) | {"pose": np.full(1, 2, "i4")})
    with pytest.raises(PhysicsError, match="names a plane that the object does not have"):
        judge(shard, LIFT, rows=bad)
    with pytest.raises(PhysicsError, match="lift lifts the object, which runs on the CPU alone: give --device cpu"):
        judge(shard, LIFT, device="cuda:0")


@pytest.mark.parametrize(("over", "holds"), [(0.8, False), (1.4, True)])
def test_free_cube_needs_jaws_that_bear_its_weight_whatever_way_it_pulls(jaws: Jaws, free, over: float, holds: bool):
    """Two jaws bear 2 mu F against 0.98 N, and against 12 % more while they rise."""
    press = over * FREE.force / (2.0 * FREE.friction)
    found = judge(below(jaws, press, count=3), free)
    assert (found["holds"] == holds).all()
    assert found["settled"].all()
    assert not found["diverged"].any()


def test_free_cube_falls_out_of_a_hand_that_does_not_grip(jaws: Jaws, free):
    """Open jaws, smooth jaws, and jaws that close beside the cube."""
    good = below(jaws, 4.0)
    assert judge(good, free)["holds"] == [True]
    opened = good.grasps.q_pregrasp
    beside = good.grasps.object_pose.copy()
    beside[..., 1] += 0.05
    for rows in (Jaws.rows(good, q=opened, q_squeeze=opened), Jaws.rows(good, object_pose=beside)):
        found = judge(good, free, rows=rows)
        assert found["holds"] == [False]
        assert found["displacement"] > FREE.most_displacement
    assert judge(good, free.model_copy(update={"friction": 0.05}))["holds"] == [False]


def test_hand_that_only_carries_holds_until_gravity_turns(jaws: Jaws, free):
    """A cube that lies on the hand between open jaws."""
    shard = jaws.shard()
    pose = shard.grasps.object_pose.copy()
    pose[..., 2] = 0.03 + EDGE / 2
    opened = shard.grasps.q_pregrasp
    carried = Jaws.rows(shard, q=opened, q_squeeze=opened, object_pose=pose)
    assert judge(shard, free.model_copy(update={"lift": FreeLift(turns=0)}), rows=carried)["holds"] == [True]
    assert judge(shard, free, rows=carried)["holds"] == [False]


def test_where_gravity_points():
    """Nowhere until the hand rises by 20 cm, then down; in the middle second of three in five random directions."""
    up, stops = np.array([0, 0.6, 0.8]), [np.zeros(1), np.ones(1), np.full(1, 3.0)]
    course, other = (course_of(FREE, stops, up, candidate=k) for k in (7, 8))
    second = round(1 / FREE.timestep)
    assert len(course.down) == len(course.targets) == len(course.way) - 1 == course.rises + 4 * second
    assert course.closes == 0
    assert not course.down[: course.rises].any()
    np.testing.assert_allclose(course.way[[0, course.rises, -1]], [0 * up, 0 * up, 0.2 * up])
    lifted = course.rises + second
    for upright in (course.down[course.rises : lifted + second], course.down[lifted + 2 * second :]):
        np.testing.assert_array_equal(upright, np.tile(-up, (len(upright), 1)))
    turned = course.down[lifted + second : lifted + 2 * second]
    ways = np.unique(turned, axis=0)
    assert len(ways) == 5
    np.testing.assert_allclose(np.linalg.norm(ways, axis=1), 1.0)
    assert all((turned == way).all(1).sum() == second // 5 for way in ways)
    np.testing.assert_array_equal(course_of(FREE, stops, up, candidate=7).down, course.down)
    assert (other.down != course.down).any()


def test_free_rows_stand_alone_and_their_text_says_all(jaws: Jaws, free):
    shard = below(jaws, 1.0, count=3)
    depth = np.array([[0.3], [4.0], [1.2]], "f4") / np.float32(SLIDING)
    rows = Jaws.rows(shard, q_squeeze=shard.grasps.q - depth)
    one, two = (judge(shard, free, rows=rows, threads=n) for n in (1, 2))
    assert one["holds"].tolist() == [False, True, True]
    single = judge(shard, free, rows=replace(rows, **{name: values[-1:] for name, values in rows.columns().items()}))
    for name, values in one.items():
        np.testing.assert_array_equal(values, two[name], err_msg=name)
        np.testing.assert_array_equal(values[-1:], single[name], err_msg=name)
    text = json.loads(protocol_text(scene_of(shard.hand, shard.objects), free))
    assert text["lift"] == {"rising": 1, "height": 0.2, "turns": 5, "turning": 1, "seed": 0}
    assert Protocol.model_validate({name: text[name] for name in Protocol.model_fields}) == free


def test_free_lift_refuses_several_objects_a_gpu_and_more_turning_than_hold(jaws: Jaws):
    with pytest.raises(
        PhysicsError, match=r"protocol dipgrasp cannot simulate these grasps: they have several objects$"
    ):
        judge(twin_shard(twin_rows()), FREE)
    with pytest.raises(PhysicsError, match="dipgrasp lifts the object, which runs on the CPU alone: give --device cpu"):
        judge(jaws.shard(), FREE, device="cuda:0")
    with pytest.raises(ConfigError, match=r"lift.turning is part of hold"):
        parse_model(Protocol, FREE.model_dump() | {"hold": 0.5}, "protocol")

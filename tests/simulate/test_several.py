"""Verdicts on several objects in one hand: what statics says, planted failures, and what must not matter."""

from dataclasses import replace

import numpy as np
import pytest
from support.jaws import EDGE
from support.judging import judge
from support.twins import SIDE, in_one_gripper, twin_rows, twin_shard

from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.protocol import PROTOCOLS
from lgrasp.simulate.scene import scene_of

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")

SEQ, SMOOTH = PROTOCOLS["seq6"], PROTOCOLS["seq6_mu06"]
WEIGHT = 500 * EDGE**3 * 9.8  # [N] of a cube
SLIDING = 500.0  # [N/m] of a jaw


def moved(rows: GraspRows, slot: int, *shift: float) -> GraspRows:
    pose = rows.object_pose.copy()
    pose[:, slot, :3] += np.array(shift, "f4")
    return replace(rows, object_pose=pose)


def alone(rows: GraspRows, slot: int) -> GraspRows:
    """The rows without the object of one slot."""
    changes = {"object_pose": np.nan, "object_index": -1, "contact_links": -1}
    changes |= dict.fromkeys(("contact_points", "contact_normals", "contact_forces"), np.nan)
    arrays = {name: getattr(rows, name).copy() for name in changes}
    for name, value in changes.items():
        arrays[name][:, slot] = value
    return replace(rows, **arrays)


def test_both_are_held():
    found = judge(twin_shard(twin_rows()), SEQ)
    assert found["holds"].all()
    assert found["stays"].all()
    assert found["object_touches"].tolist() == [[1, 1]]
    assert (found["directions"] == 1).all()
    assert (found["object_displacement"] < 1e-3).all()
    np.testing.assert_allclose(found["object_displacement"].max(1), found["displacement"].max(1))
    assert found["contact_at_q"] == 2
    assert 0 < found["penetration"] < 1e-3


@pytest.mark.parametrize("name", [name for name, protocol in PROTOCOLS.items() if not protocol.lift])
def test_one_in_the_air_is_lost(name: str):
    """Every protocol says so of the row, and of which object; a weight pulls both alike, so it flies with 9.8 m/s2."""
    protocol = PROTOCOLS[name].model_copy(update={"hold": 0.25})
    rows = moved(twin_rows(), 1, 0, 0, 0.5)
    found = judge(twin_shard(rows), protocol, all_directions=True)
    assert not found["holds"].any()
    assert not found["stays"].any()
    if protocol.shake:
        assert found["object_touches"].tolist() == [[1, 0]]
    elif protocol.success == "touches":
        assert found["object_touches"].tolist() == [[1, 0]]
        np.testing.assert_allclose(found["displacement"], 0.5 * 9.8 * 0.25**2, rtol=0.02)
    assert found["object_displacement"][0, 0] < (5e-3 if protocol.draws else 2e-3)  # softer drives are drawn
    assert found["object_displacement"][0, 1] > protocol.most_displacement


def test_cubes_inside_each_other_fail():
    """By 12 mm: too deep for a simulation. By 8 mm, which is allowed: it runs."""
    free = moved(in_one_gripper(0.0), 0, 0, 0, 0.2)
    for depth, run in ((0.012, False), (0.008, True)):
        found = judge(twin_shard(free), SEQ, rows=moved(moved(free, 1, 0, 0, 0.2), 0, -depth, 0, 0))
        assert found["penetration"] == pytest.approx(depth, abs=2e-4)
        assert (found["directions"] >= 0).any() == run
        assert not found["holds"].any()
        assert found["object_touches"].tolist() == [[0, 0] if run else [-1, -1]]


def test_cubes_do_not_pass_through_each_other():
    """In one gripper each cube reaches one jaw only: what holds them is that they press on each other."""
    normal = 8 * WEIGHT
    found = judge(twin_shard(in_one_gripper(normal / SLIDING)), SMOOTH)
    assert found["holds"].all()
    assert found["stays"].all()
    assert found["penetration"] < 3e-3
    lone = alone(in_one_gripper(normal / SLIDING), 1)  # nothing is behind it
    assert not judge(twin_shard(lone), SMOOTH)["holds"].any()


@pytest.mark.parametrize(("normal", "holds"), [(1.2, False), (2.4, True)])
def test_each_jaw_bears_friction_times_force(normal: float, holds: bool):
    """Along z a jaw bears 0.6 x N of the cube's weight W: two cubes in one gripper stay when 0.6 x N > W."""
    found = judge(twin_shard(in_one_gripper(normal * WEIGHT / SLIDING)), SMOOTH, all_directions=True)
    assert found["directions"][0, 4] == holds == (0.6 * normal > 1)


def test_a_row_sees_its_own_objects_only():
    """A row of one object gives what a shard of that object gives, whatever else the file holds and the scene knows."""
    both = twin_rows(0.0006)
    cube = twin_shard(both).objects[0]
    parent = alone(both, 1)
    mixed = replace(both, **{n: np.concatenate([v, parent.columns()[n]]) for n, v in both.columns().items()})
    in_file = judge(twin_shard(mixed), SEQ)
    slots = ("object_pose", "object_index", "contact_points", "contact_normals", "contact_links", "contact_forces")
    lone = replace(both, **{name: getattr(both, name)[:, :1] for name in slots})
    by_itself = judge(replace(twin_shard(lone), objects=[cube]), SEQ)
    assert in_file["object_touches"].tolist() == [[1, 1], [1, -1]]
    assert np.isnan(in_file["object_displacement"][1, 1])
    for name, values in by_itself.items():
        own = in_file[name][1:, :1] if name.startswith("object_") else in_file[name][1:]
        np.testing.assert_array_equal(values, own, err_msg=name)


def test_order_of_slots_does_not_matter():
    """The cube of one gripper is lighter; slots exchanged, the same with the columns exchanged."""
    rows = moved(twin_rows(0.0004, count=1), 1, 0, 0, 0.01)
    shard = twin_shard(rows, heights=(EDGE, EDGE / 2))
    turned = replace(rows, **{n: getattr(rows, n)[:, ::-1] for n in rows.columns() if "object" in n or "contact" in n})
    a, b = judge(shard, SEQ), judge(shard, SEQ, rows=turned)
    assert a["object_displacement"][0, 0] > 1.2 * a["object_displacement"][0, 1]
    for name, values in a.items():
        np.testing.assert_array_equal(values, b[name][:, ::-1] if name.startswith("object_") else b[name], err_msg=name)


def test_the_same_object_twice():
    rows = twin_rows()
    once = twin_shard(replace(rows, object_index=np.zeros((1, 2), "i4")))
    a, b = judge(twin_shard(rows), SEQ), judge(replace(once, objects=once.objects[:1]), SEQ)
    for name, values in a.items():
        np.testing.assert_array_equal(values, b[name], err_msg=name)


def test_touching_and_staying_are_two_things():
    """An object that moves too far for us still touches: all six directions are run to say so."""
    strict = SEQ.model_copy(update={"most_displacement": 1e-4})
    found = judge(twin_shard(twin_rows()), strict)
    assert found["holds"].all()
    assert not found["stays"].any()
    assert (found["directions"] == 1).all()


def test_it_starts_at_q():
    """q_pregrasp says nothing: the objects are held already."""
    rows = twin_rows()
    a, b = (judge(twin_shard(r), SEQ) for r in (rows, replace(rows, q_pregrasp=np.full_like(rows.q, 0.06))))
    for name, values in a.items():
        np.testing.assert_array_equal(values, b[name], err_msg=name)
    inside = replace(rows, q=rows.q - np.float32(0.012))
    deep = judge(twin_shard(inside), SEQ)
    assert deep["pregrasp_penetration"] == pytest.approx(0.012, abs=2e-4)
    assert (deep["directions"] == -1).all()


def test_numbers_of_the_published_protocol():
    for protocol, friction in ((SEQ, 2.0), (SMOOTH, 0.6)):
        assert (protocol.density, protocol.friction) == (500, friction)
        assert protocol.hold == pytest.approx(100 / 60)
        assert (protocol.most_penetration, protocol.most_displacement) == (0.01, 0.02)
        load = protocol.load(EDGE**3)
        assert load.force == pytest.approx(WEIGHT)


def test_a_scene_by_hand():
    """Objects count by their ids, in whatever order they are given."""
    shard = twin_shard(twin_rows())
    scene = scene_of(shard.hand, shard.objects[::-1])
    assert [solid.name for solid in scene.objects] == ["one", "two"]
    np.testing.assert_allclose(scene.hand.pieces["al"][0].vertices.mean(0), [0.005, 0, 0.03], atol=1e-6)
    assert SIDE > EDGE

"""Every simulator is given what MuJoCo is given: bodies at their places, drives and couplings that go the same way."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from support.jaws import mesh_record, shipped_hand
from support.simulators import need
from support.solids import no_cut

from lgrasp.errors import PhysicsError
from lgrasp.simulate.engines import make_world
from lgrasp.simulate.model import build_model
from lgrasp.simulate.mujoco_world import MujocoWorld
from lgrasp.simulate.protocol import PROTOCOLS
from lgrasp.simulate.scene import Scene, hand_of_record
from lgrasp.simulate.solid import object_of_record

mujoco = pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")


@pytest.fixture
def other(engine):
    """Each simulator but MuJoCo."""
    if engine == "mujoco":
        pytest.skip("the others are compared with it")
    return engine


def worlds(name: str, engine: str):
    """The model of a shipped hand with a cube far away, the hand's tree, and the model in MuJoCo and in another one."""
    record, _, tree = shipped_hand(name)
    cube = object_of_record(mesh_record("cube", trimesh.creation.box([0.03] * 3)))
    q = tree.listed_values(tree.joint_open[None])[0]
    model = build_model(Scene(hand_of_record(record, no_cut), (cube,)), PROTOCOLS["fc"].by(engine), q)
    both = MujocoWorld(model), make_world(model)
    for world in both:
        world.begin(q, np.array([[1.0, 2.0, 3.0, 0.5, 0.5, -0.5, 0.5]]))
    return model, tree, *both


def hand_joints(world) -> np.ndarray:
    """Positions of the hand's joints as MuJoCo counts them (J,) [rad or m], by the frames of its bodies."""
    m, (at, turn), found = world._model.mujoco, world.frames(), []
    for j in np.flatnonzero(m.jnt_type != mujoco.mjtJoint.mjJNT_FREE):
        body, parent = m.jnt_bodyid[j], m.body_parentid[m.jnt_bodyid[j]]
        still = turn[parent] @ Rotation.from_quat(m.body_quat[body], scalar_first=True).as_matrix()
        moved = still.T @ (at[body] - at[parent] - turn[parent] @ m.body_pos[body])
        turned = Rotation.from_matrix(still.T @ turn[body]).as_rotvec()
        found.append(m.jnt_axis[j] @ (moved if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_SLIDE else turned))
    return np.array(found)


@pytest.mark.parametrize("name", ["allegro", "barrett", "schunk_svh", "shadow"])
def test_the_hand_goes_where_mujoco_puts_it(name: str, other: str):
    model, tree, *both = worlds(name, other)
    span = 0.15 * (tree.joint_upper - tree.joint_open)
    target = tree.listed_values((tree.joint_open + span)[None].astype("f4"))[0]
    for steps, atol in ((0, 1e-5), (150, 1.5e-3)):
        for world in both:
            if steps:
                world.drive(model.controls(target))
                world.step(steps)
        (at, turn), (at_other, turn_other) = (world.frames() for world in both)
        np.testing.assert_allclose(at_other, at, atol=atol)
        np.testing.assert_allclose(turn_other, turn, atol=20 * atol)
        np.testing.assert_allclose(both[1].objects(), both[0].objects(), atol=1e-5)


def test_what_was_tried_leaves_no_trace(jaws, other: str):
    """A gripper that squeezes a cube goes on alike, whether states were restored on the way or not."""
    shard = jaws.shard()
    rows, scene = shard.grasps, Scene(hand_of_record(shard.hand, no_cut), (object_of_record(shard.objects[0]),))
    model = build_model(scene, PROTOCOLS["fc"].by(other), rows.q[0])
    world = make_world(model)
    tilted = rows.object_pose[0] + np.array([0, 0.003, 0.002, 0, 0.02, 0.03, 0.01])

    def poses(tries: int) -> np.ndarray:
        world.begin(rows.q_pregrasp[0], tilted)
        world.drive(model.controls(rows.q_squeeze[0].astype(float)))
        world.push(np.array([[0.0, 0.5, 0.0]]))
        world.step(150)
        before = world.state()
        for number in range(tries):
            world.push(np.full((1, 3), 1.0 + number))
            world.step(30)
            world.restore(before)
        assert world.links_touching() == 2
        world.step(50)
        return np.concatenate([world.objects().ravel(), hand_joints(world)])

    np.testing.assert_array_equal(poses(2), poses(0))


def test_a_world_that_ran_away_begins_again(jaws, engine: str, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # MuJoCo leaves a log there
    shard = jaws.shard()
    rows, scene = shard.grasps, Scene(hand_of_record(shard.hand, no_cut), (object_of_record(shard.objects[0]),))
    world = make_world(build_model(scene, PROTOCOLS["fc"].by(engine), rows.q[0]))
    for force, wild in ((0.0, False), (np.nan, True), (0.0, False)):
        world.begin(rows.q_pregrasp[0], rows.object_pose[0])
        world.push(np.array([[force, 0.0, 0.0]]))
        world.step(10)
        assert world.wild() == wild


def test_what_drake_refuses_is_one_line(jaws):
    need("drake")
    shard = jaws.shard()
    scene = Scene(hand_of_record(shard.hand, no_cut), (object_of_record(shard.objects[0]),))
    model = build_model(scene, PROTOCOLS["fc"].by("drake"), shard.grasps.q[0]).own()
    model.mujoco.body_inertia[model.object_body] = [1.0, 1.0, 3.0]  # of no body: the third is more than both
    with pytest.raises(PhysicsError, match=r"^Drake refuses the hand or an object: .{10,300}$"):
        make_world(model)


@pytest.mark.parametrize("name", ["barrett", "schunk_svh"])
def test_joints_of_one_drive_give_way_together(name: str, other: str):
    """Every link of a hand twisted by 0.03 N m: joints turn as the torques on all joints of their drive have it."""
    model, tree, mujoco_world, other_world = worlds(name, other)
    posture = tree.listed_values((tree.joint_open + 0.2 * (tree.joint_upper - tree.joint_open))[None].astype("f4"))[0]
    m, data, torque = model.mujoco, mujoco_world.data, np.array([0.03, 0.03, 0.0])
    hand = [body for body in range(1, m.nbody) if body not in model.object_body]
    for world in (mujoco_world, other_world):
        world.begin(posture, np.array([[1.0, 2.0, 3.0, 1, 0, 0, 0]]))
    rest, turning = hand_joints(mujoco_world), np.zeros(m.nv)
    for body in hand:
        spin = np.zeros((3, m.nv))
        mujoco.mj_jacBody(m, data, None, spin, body)
        turning += spin.T @ torque
    joints = m.jnt_dofadr[[j for j in range(m.njnt) if m.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]]
    M = model.joint_matrix
    wanted = M @ (M.T @ turning[joints]) / model.protocol.stiffness
    for world in (mujoco_world, other_world):
        world.press({body: (np.zeros(3), torque) for body in hand})
        world.step(300)
    moved, moved_other = hand_joints(mujoco_world) - rest, hand_joints(other_world) - rest
    most = np.abs(wanted).max()
    assert most > 0.01
    np.testing.assert_allclose(moved, wanted, atol=0.03 * most)
    np.testing.assert_allclose(moved_other, wanted, rtol=0.2, atol=0.1 * most)


@pytest.mark.parametrize("share", [0.85, 1.15])
def test_joints_of_one_drive_press_no_harder_than_its_effort(engine: str, share: float):
    """A torque on the outer link of a finger turns both of its joints away unless their drive can bear it."""
    record, _, tree = shipped_hand("barrett")
    cube = object_of_record(mesh_record("cube", trimesh.creation.box([0.03] * 3)))
    posture = tree.listed_values((tree.joint_open + 0.2 * (tree.joint_upper - tree.joint_open))[None].astype("f4"))[0]
    model = build_model(Scene(hand_of_record(record, no_cut), (cube,)), PROTOCOLS["fc"].by(engine), posture).own()
    M, m = model.joint_matrix, model.mujoco
    column = int(np.flatnonzero((M != 0).sum(0) > 1)[-1])
    joints = np.flatnonzero(M[:, column])  # of one drive; of the model, too, as the hand comes first
    outer = int(m.jnt_bodyid[joints[-1]])
    world = MujocoWorld(model)
    world.begin(posture, np.array([[1.0, 2.0, 3.0, 1, 0, 0, 0]]))
    torque = 0.1 * world.data.xaxis[joints[-1]]
    spin = np.zeros((3, m.nv))
    mujoco.mj_jacBody(m, world.data, None, spin, outer)
    asked = M[joints, column] @ (spin.T @ torque)[m.jnt_dofadr[joints]]
    m.jnt_actfrclimited[joints], m.jnt_actfrcrange[joints] = 1, share * abs(asked) * np.array([-1, 1])
    world = make_world(model)
    world.begin(posture, np.array([[1.0, 2.0, 3.0, 1, 0, 0, 0]]))
    before = hand_joints(world)
    world.press({outer: (np.zeros(3), torque)})
    world.step(300)
    moved = np.abs((hand_joints(world) - before)[joints] / M[joints, column])
    yields = abs(asked) / model.protocol.stiffness
    assert (moved > 5 * yields).all() if share < 1 else (moved < 2 * yields).all(), moved / yields

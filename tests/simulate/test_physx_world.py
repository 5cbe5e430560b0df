"""PhysX is given what MuJoCo is given: every body at its place, and drives and couplings that go the same way."""

import numpy as np
import pytest
import trimesh
from support.jaws import mesh_record, shipped_hand

from lgrasp.errors import DecomposeError
from lgrasp.simulate.model import build_model
from lgrasp.simulate.mujoco_world import MujocoWorld
from lgrasp.simulate.physx_world import PhysxWorld
from lgrasp.simulate.protocol import PROTOCOLS
from lgrasp.simulate.scene import Scene, hand_of_record, object_of_record

pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")
pytest.importorskip("sapien", reason="PhysX is not installed (extra physx)", exc_type=ImportError)


def no_cut(*_: object, **__: object) -> list[np.ndarray]:
    raise DecomposeError("made up")


@pytest.mark.parametrize("name", ["allegro", "barrett", "schunk_svh", "shadow"])
def test_the_hand_goes_where_mujoco_puts_it(name: str):
    record, _, tree = shipped_hand(name)
    cube = object_of_record(mesh_record("cube", trimesh.creation.box([0.03] * 3)))
    q = tree.listed_values(tree.joint_open[None])[0]
    model = build_model(Scene(hand_of_record(record, no_cut), (cube,)), PROTOCOLS["fc"], q)
    poses = np.array([[1.0, 2.0, 3.0, 0.5, 0.5, -0.5, 0.5]])
    worlds = MujocoWorld(model), PhysxWorld(model)
    span = 0.15 * (tree.joint_upper - tree.joint_open)
    target = tree.listed_values((tree.joint_open + span)[None].astype("f4"))[0]
    for q_now, atol in ((q, 1e-5), (target, 1.5e-3)):
        for world in worlds:
            if q_now is q:
                world.begin(q, poses)
            else:
                world.drive(model.controls(target))
                world.step(150)
        (at, turn), (at_physx, turn_physx) = (world.frames() for world in worlds)
        np.testing.assert_allclose(at_physx, at, atol=atol)
        np.testing.assert_allclose(turn_physx, turn, atol=20 * atol)
        np.testing.assert_allclose(worlds[1].objects(), worlds[0].objects(), atol=1e-5)

"""The world in MuJoCo."""

from typing import Any

import numpy as np

from lgrasp.simulate.model import Model
from lgrasp.simulate.verdict import WILD
from lgrasp.simulate.world import World


class MujocoWorld(World):
    """A MuJoCo model and its data.

    Args:
        near: hand and objects touch within 1 mm.
    """

    def __init__(self, model: Model, *, near: bool = False) -> None:
        import mujoco

        super().__init__(model)
        self._lib: Any = mujoco
        self._m = model.mujoco_near if near else model.mujoco
        self.data = mujoco.MjData(self._m)
        self._of_object = np.isin(self._m.geom_bodyid, model.object_body)

    def begin(self, q: np.ndarray, poses: np.ndarray) -> None:
        """As of :class:`World`; contacts are found."""
        model, lib, data = self._model, self._lib, self.data
        lib.mj_resetData(self._m, data)
        data.qpos[model.joint_address] = model.joint_matrix @ q + model.joint_offset
        data.ctrl[:] = model.controls(q)
        lib.mj_kinematics(self._m, data)
        at, turn = np.zeros(3), np.zeros(4)
        base = model.base_body
        for address, pose in zip(model.object_address, poses.astype(float), strict=True):
            lib.mju_mulPose(at, turn, data.xpos[base], data.xquat[base], pose[:3], pose[3:])
            data.qpos[address] = [*at, *(turn / np.linalg.norm(turn))]
        lib.mj_kinematics(self._m, data)
        lib.mj_comPos(self._m, data)
        lib.mj_collision(self._m, data)

    def drive(self, targets: np.ndarray) -> None:
        self.data.ctrl[:] = targets

    def press(self, loads: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
        self.data.xfrc_applied[:] = 0.0
        for body, load in loads.items():
            self.data.xfrc_applied[body] = np.concatenate(load)

    def place_table(self, pose: np.ndarray) -> None:
        self.data.qpos[self._model.table.address] = self._table = np.array(pose, float)

    def slide_table(self, by: np.ndarray) -> None:
        table = self._model.table
        self.data.qpos[table.address] = self._table
        self.data.qvel[table.velocity] = [*(by / self._m.opt.timestep), 0, 0, 0]
        self._table[:3] += by

    def step(self, steps: int) -> None:
        self._lib.mj_step(self._m, self.data, steps)

    def state(self) -> np.ndarray:
        spec = self._lib.mjtState.mjSTATE_INTEGRATION
        state = np.zeros(self._lib.mj_stateSize(self._m, spec))
        self._lib.mj_getState(self._m, self.data, state, spec)
        return state

    def restore(self, state: np.ndarray) -> None:
        self._lib.mj_setState(self._m, self.data, state, self._lib.mjtState.mjSTATE_INTEGRATION)

    def take(self, qpos: np.ndarray, qvel: np.ndarray, warmstart: np.ndarray, targets: np.ndarray) -> None:
        """Go on from the state of another simulation of the model, its last accelerations included."""
        self._lib.mj_resetData(self._m, self.data)
        self.data.qpos[:], self.data.qvel[:] = qpos, qvel
        self.data.qacc_warmstart[:], self.data.ctrl[:] = warmstart, targets

    def objects(self) -> np.ndarray:
        return self.data.qpos[self._model.object_address]

    def velocities(self) -> np.ndarray:
        return self.data.qvel[self._model.object_velocity]

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        self._lib.mj_kinematics(self._m, self.data)
        return self.data.xpos, self.data.xmat.reshape(-1, 3, 3)

    def touching(self) -> np.ndarray:
        return self._m.geom_bodyid[self.data.contact.geom]

    def deepest(self, *, of_links: bool = False) -> float:
        """Deepest penetration of any object, in a link or in another object; of links in links too if asked [m]."""
        contact = self.data.contact
        chosen = slice(None) if of_links else self._of_object[contact.geom].any(1)
        return max(0.0, -float(contact.dist[chosen].min(initial=0.0)))

    def wild(self) -> bool:
        return not np.abs(self.data.qvel).max() < WILD or not np.isfinite(self.data.qpos).all()

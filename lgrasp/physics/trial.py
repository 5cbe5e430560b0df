"""One grasp in MuJoCo: close the hand once, then pull the object in each direction from that same state."""

from typing import Any, NamedTuple

import numpy as np

from lgrasp.dataset.records import GraspRows
from lgrasp.physics.model import Model

__all__ = ["AXES", "CHUNK", "REST", "WILD", "Trial", "Verdict", "is_safe"]

CHUNK = 0.1
"""[s] between looks at the object."""
WILD = 1.0e3
"""[m/s or rad/s]: no hand and no object is so fast, the simulation has diverged."""
REST = (0.01, 0.1)
"""[m/s], [rad/s]: slower is at rest."""
AXES = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], float)
"""Directions of the load in the hand's base frame."""


class Verdict(NamedTuple):
    """What is found of one grasp; COLUMNS says what the numbers mean."""

    holds: bool
    directions: np.ndarray  # (6,) i8
    displacement: np.ndarray  # (6,) [m]
    rotation: np.ndarray  # (6,) [rad]
    slip: float
    contact_at_q: int
    contact_at_grasp: int
    pregrasp_penetration: float
    settled: bool
    diverged: bool


class _Closed(NamedTuple):
    """The closed hand."""

    contacts: int = 0
    slip: float = np.nan
    settled: bool = False
    displacement: float = np.nan
    rotation: float = np.nan


class Trial:
    """A simulation that serves one grasp after another; every thread has its own.

    Args:
        all_directions: go on after a direction in which the object is lost.
        settled_stop: end a direction early when the object has come to rest well inside its bounds.
    """

    def __init__(self, model: Model, *, all_directions: bool = False, settled_stop: bool = True) -> None:
        import mujoco

        self._lib: Any = mujoco
        self._model, self._protocol, self._m = model, model.protocol, model.mujoco
        self._data, self._near = mujoco.MjData(self._m), mujoco.MjData(model.mujoco_near)
        self._all, self._settled_stop = all_directions, settled_stop
        self._state = np.zeros(mujoco.mj_stateSize(self._m, mujoco.mjtState.mjSTATE_INTEGRATION))
        self._chunk = max(1, round(CHUNK / self._m.opt.timestep))
        self._limits = (self._protocol.most_displacement, np.radians(self._protocol.most_rotation))
        self.steps = 0

    def run(self, rows: GraspRows, i: int) -> Verdict:
        """Judge row ``i``."""
        points, contact_at_q, depth, _ = self.look(rows, i)
        self._start = self._object()
        directions = np.full(6, -1, np.int8)
        moved = np.full((6, 2), np.nan)
        closed, diverged = _Closed(), False
        if depth <= self._protocol.most_penetration:
            closed = self._close(rows, i, points)
            diverged = self._wild()
            lost = diverged or closed.displacement > self._limits[0] or closed.rotation > self._limits[1]
            if lost:
                directions[:], moved[:] = 0, (closed.displacement, closed.rotation)
            else:
                self._lib.mj_getState(self._m, self._data, self._state, self._lib.mjtState.mjSTATE_INTEGRATION)
                for k, axis in enumerate(AXES):
                    directions[k], moved[k] = self._pull(axis, closed)
                    diverged |= self._wild()
                    if not directions[k] and not self._all:
                        break
        return Verdict(
            bool((directions == 1).all()),
            directions,
            moved[:, 0],
            moved[:, 1],
            closed.slip,
            contact_at_q,
            closed.contacts,
            depth,
            closed.settled,
            diverged,
        )

    def look(self, rows: GraspRows, i: int) -> tuple[np.ndarray, int, float, np.ndarray]:
        """Row ``i`` before it is simulated, hand at q_pregrasp.

        Returns:
            Contact points on their links at q (C, 3), links within 1 mm of the object at q, deepest penetration at
            q_pregrasp [m], and the state there (qpos).
        """
        points, contact_at_q = self._look_at_q(rows, i)
        self._place(self._m, self._data, rows.q_pregrasp[i], rows.object_pose[i, 0])
        return points, contact_at_q, self._deepest(), self._data.qpos.copy()

    def base_rotation(self) -> np.ndarray:
        """Of the hand's base in the world, (3, 3)."""
        self._lib.mj_kinematics(self._m, self._data)
        return self._data.xmat[self._model.base_body].reshape(3, 3).copy()

    def slip_at(self, rows: GraspRows, i: int, points: np.ndarray, qpos: np.ndarray) -> float:
        """Slip of row ``i`` in a given state; ``points`` as of :meth:`look`."""
        self._data.qpos[:] = qpos
        return self._slip(rows, i, points)

    def _close(self, rows: GraspRows, i: int, points: np.ndarray) -> _Closed:
        """From pregrasp to grasp to squeeze, each target approached evenly; ends early when all is lost."""
        stops = [targets[i].astype(float) for targets in (rows.q_pregrasp, rows.q, rows.q_squeeze)]
        contacts, worst = 0, (0.0, 0.0)
        steps = max(1, round(self._protocol.phase / self._m.opt.timestep))
        for phase in (0, 1):
            a, b = self._model.controls(stops[phase]), self._model.controls(stops[phase + 1])
            for step in range(steps):
                self._data.ctrl[:] = a + (b - a) * ((step + 1) / steps)
                self._step(1)
                if (step + 1) % self._chunk == 0 or step + 1 == steps:
                    moved = self._moved()
                    worst = (max(worst[0], moved[0]), max(worst[1], moved[1]))
                    if self._wild():
                        return _Closed(contacts)
                    if worst[0] > self._limits[0] or worst[1] > self._limits[1]:
                        return _Closed(contacts, displacement=worst[0], rotation=worst[1])
            if phase == 0:
                contacts = self._touching_at_rest()
        velocity = self._data.qvel[-6:]
        rest = bool(np.linalg.norm(velocity[:3]) < REST[0] and np.linalg.norm(velocity[3:]) < REST[1])
        return _Closed(contacts, self._slip(rows, i, points), rest, *worst)

    def _touching_at_rest(self) -> int:
        """Links that touch the object once the hand has caught up with its targets; the trial goes on from before."""
        lib = self._lib
        lib.mj_getState(self._m, self._data, self._state, lib.mjtState.mjSTATE_INTEGRATION)
        self._step(max(1, round(self._protocol.settle / self._m.opt.timestep)))
        touching = self._links_touching(self._m, self._data)
        lib.mj_setState(self._m, self._data, self._state, lib.mjtState.mjSTATE_INTEGRATION)
        return touching

    def _pull(self, axis: np.ndarray, closed: _Closed) -> tuple[int, tuple[float, float]]:
        """Load one direction [hand base frame]; 1 or 0, and how far the object moved [m], [rad] at worst."""
        lib, data, model = self._lib, self._data, self._model
        lib.mj_setState(self._m, data, self._state, lib.mjtState.mjSTATE_INTEGRATION)
        R_base = data.xmat[model.base_body].reshape(3, 3)
        data.xfrc_applied[model.object_body, :3] = model.load.force * (R_base @ axis)
        worst = (closed.displacement, closed.rotation)
        total = max(1, round(self._protocol.hold / self._m.opt.timestep))
        done, before = 0, self._moved()
        while done < total:
            steps = min(self._chunk, total - done)
            self._step(steps)
            done += steps
            moved = self._moved()
            worst = (max(worst[0], moved[0]), max(worst[1], moved[1]))
            if self._wild():
                return 0, (np.nan, np.nan)
            if worst[0] > self._limits[0] or worst[1] > self._limits[1]:
                return 0, worst
            if self._settled_stop and is_safe(before, moved, self._limits, (total - done) / steps):
                break
            before = moved
        return 1, worst

    def _step(self, steps: int) -> None:
        self._lib.mj_step(self._m, self._data, steps)
        self.steps += steps

    def _place(self, m: Any, data: Any, q: np.ndarray, pose: np.ndarray) -> None:
        """Hand at q (K,), object at pose (7,) in the base frame, everything at rest; contacts are found."""
        model, lib = self._model, self._lib
        lib.mj_resetData(m, data)
        data.qpos[model.joint_address] = model.joint_matrix @ q + model.joint_offset
        data.ctrl[:] = self._model.controls(q)
        lib.mj_kinematics(m, data)
        at, turn = np.zeros(3), np.zeros(4)
        base = model.base_body
        lib.mju_mulPose(at, turn, data.xpos[base], data.xquat[base], pose[:3].astype(float), pose[3:].astype(float))
        data.qpos[model.object_address :][:7] = [*at, *(turn / np.linalg.norm(turn))]
        lib.mj_kinematics(m, data)
        lib.mj_comPos(m, data)
        lib.mj_collision(m, data)

    def _look_at_q(self, rows: GraspRows, i: int) -> tuple[np.ndarray, int]:
        """Contact points on their links at q, as (C, 3) in body frames [m], and the number of links within 1 mm."""
        model, data = self._model, self._near
        self._place(model.mujoco_near, data, rows.q[i], rows.object_pose[i, 0])
        body = model.link_body[rows.contact_links[i, 0]]
        T = data.xmat[model.object_body].reshape(3, 3)
        world = data.xpos[model.object_body] + rows.contact_points[i, 0] @ T.T
        R = data.xmat[body].reshape(-1, 3, 3)
        points = np.einsum("cji,cj->ci", R, world - data.xpos[body])
        return points, self._links_touching(model.mujoco_near, data)

    def _slip(self, rows: GraspRows, i: int, points: np.ndarray) -> float:
        """How far the points of links are from the contact points that they made at q [m], largest; NaN: none."""
        data, model = self._data, self._model
        links = rows.contact_links[i, 0]
        if not (links >= 0).any():
            return np.nan
        self._lib.mj_kinematics(self._m, data)
        body = model.link_body[links]
        world = data.xpos[body] + np.einsum("cij,cj->ci", data.xmat[body].reshape(-1, 3, 3), points)
        seen = (world - data.xpos[model.object_body]) @ data.xmat[model.object_body].reshape(3, 3)
        return float(np.linalg.norm(seen - rows.contact_points[i, 0], axis=1)[links >= 0].max())

    def _links_touching(self, m: Any, data: Any) -> int:
        """Number of the hand's bodies in contact with the object."""
        pairs = m.geom_bodyid[data.contact.geom]
        with_object = (pairs == self._model.object_body).any(1)
        return len(np.setdiff1d(pairs[with_object], [self._model.object_body]))

    def _deepest(self) -> float:
        """Deepest penetration of all contacts [m]."""
        return max(0.0, -float(self._data.contact.dist.min(initial=0.0)))

    def _object(self) -> tuple[np.ndarray, np.ndarray]:
        """Centre of mass (3,) [m] and orientation (4,) of the object."""
        pose, center = self._data.qpos[self._model.object_address :][:7].copy(), np.zeros(3)
        self._lib.mju_rotVecQuat(center, self._model.center, pose[3:])
        return pose[:3] + center, pose[3:]

    def _moved(self) -> tuple[float, float]:
        """How far the object is from its start: displacement [m] and rotation [rad]."""
        center, turn = self._object()
        cosine = min(1.0, abs(float(turn @ self._start[1])) / max(float(np.linalg.norm(turn)), 1e-12))
        return float(np.linalg.norm(center - self._start[0])), 2 * float(np.arccos(cosine))

    def _wild(self) -> bool:
        """Has the simulation diverged?"""
        return not np.abs(self._data.qvel).max() < WILD or not np.isfinite(self._data.qpos).all()


def is_safe(before: Any, now: Any, limits: Any, chunks: Any) -> Any:
    """Would an object that moved so in a chunk stay inside half its bounds at four times that pace to the end?

    Args:
        before, now: displacement and rotation, (2,) or (2, N). limits: (2,). chunks: left, a number or (N,).
    """
    (d0, r0), (d1, r1), (d, r) = before, now, limits
    return (d1 + 4 * abs(d1 - d0) * chunks < 0.5 * d) & (r1 + 4 * abs(r1 - r0) * chunks < 0.5 * r)

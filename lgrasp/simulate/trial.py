"""One grasp in MuJoCo: close the hand once, then pull the objects in each direction from that same state."""

from itertools import pairwise
from typing import Any

import numpy as np

from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.model import Model
from lgrasp.simulate.verdict import (
    AXES,
    CHUNK,
    WILD,
    Bounds,
    Closed,
    Look,
    Pulls,
    Verdict,
    at_rest,
    conclude,
    links_touching,
    moved,
)


class Trial:
    """A simulation that serves one grasp after another; every thread has its own.

    Args:
        model: O objects in the order of the rows.
        all_directions: continue after a direction in which the grasp is lost.
        settled_stop: end a direction early when the objects have come to rest well inside their bounds.
    """

    def __init__(self, model: Model, *, all_directions: bool = False, settled_stop: bool = True) -> None:
        import mujoco

        self._lib: Any = mujoco
        self._model, self._protocol, self._m = model, model.protocol, model.mujoco
        self._data, self._near = mujoco.MjData(self._m), mujoco.MjData(model.mujoco_near)
        self._all, self._settled_stop = all_directions, settled_stop
        self._state = np.zeros(mujoco.mj_stateSize(self._m, mujoco.mjtState.mjSTATE_INTEGRATION))
        self._chunk = max(1, round(CHUNK / self._m.opt.timestep))
        self._bounds = Bounds(model.protocol)
        self._of_object = np.isin(self._m.geom_bodyid, model.object_body)
        self.steps = 0

    def run(self, rows: GraspRows, i: int) -> Verdict:
        """Judge row ``i``."""
        look = self.look(rows, i)
        self._start = self._objects()
        objects = len(self._model.object_body)
        closed = Closed(0, np.nan, False, np.full((objects, 2), np.nan), look.object_depth)
        pulls, diverged = Pulls.of(objects), False
        if look.depth <= self._protocol.most_penetration:
            closed = self._close(rows, i, look)
            diverged = self._wild()
            if diverged or self._bounds.lost(closed.moved):
                pulls.held[:], pulls.moved[:] = 0, closed.moved
            else:
                self._lib.mj_getState(self._m, self._data, self._state, self._lib.mjtState.mjSTATE_INTEGRATION)
                diverged = self._pull_all(closed, pulls)
        return conclude(self._bounds, look, closed, pulls, diverged)

    def look(self, rows: GraspRows, i: int) -> Look:
        """Row ``i`` before it is simulated, hand where the protocol starts."""
        points, contact_at_q = self._look_at_q(rows, i)
        self._place(self._m, self._data, self._protocol.stops(rows)[0][i], rows.object_pose[i])
        depth = max(0.0, -float(self._data.contact.dist.min(initial=0.0)))
        return Look(points, contact_at_q, depth, self._deepest(), self._data.qpos.copy())

    def base_rotation(self) -> np.ndarray:
        """Of the hand's base in the world, (3, 3)."""
        self._lib.mj_kinematics(self._m, self._data)
        return self._data.xmat[self._model.base_body].reshape(3, 3).copy()

    def slip_at(self, rows: GraspRows, i: int, points: np.ndarray, qpos: np.ndarray) -> float:
        """Slip of row ``i`` in a given state; ``points`` as of :meth:`look`."""
        self._data.qpos[:] = qpos
        return self._slip(rows, i, points)

    def _close(self, rows: GraspRows, i: int, look: Look) -> Closed:
        """From the start to the squeeze, each target approached evenly; ends early when all is lost."""
        stops = [self._model.controls(targets[i].astype(float)) for targets in self._protocol.stops(rows)]
        contacts, worst, depth = 0, np.zeros((len(self._model.object_body), 2)), look.object_depth
        ramp = steps = max(1, round(self._protocol.phase / self._m.opt.timestep))
        for a, b in pairwise(stops):
            if b is stops[-1]:  # the targets are q, the squeeze is next
                contacts = self._touching_at_rest()
                steps += round(self._protocol.rest / self._m.opt.timestep)
            for step in range(steps):
                self._data.ctrl[:] = a + (b - a) * min((step + 1) / ramp, 1.0)
                self._step(1)
                if (step + 1) % self._chunk == 0 or step + 1 == steps:
                    worst = np.maximum(worst, self._moved())
                    if self._wild():
                        return Closed(contacts, np.nan, False, np.full_like(worst, np.nan), depth)
                    depth = max(depth, self._deepest())
                    if self._bounds.lost(worst):
                        return Closed(contacts, np.nan, False, worst, depth)
        rest = bool(at_rest(self._data.qvel[self._model.object_velocity]))
        return Closed(contacts, self._slip(rows, i, look.points), rest, worst, depth)

    def _touching_at_rest(self) -> int:
        """Fewest links on any object, at rest at the targets; the trial then continues from the previous state."""
        lib = self._lib
        lib.mj_getState(self._m, self._data, self._state, lib.mjtState.mjSTATE_INTEGRATION)
        self._step(max(1, round(self._protocol.settle / self._m.opt.timestep)))
        touching = self._links_touching(self._m, self._data)
        lib.mj_setState(self._m, self._data, self._state, lib.mjtState.mjSTATE_INTEGRATION)
        return int(touching.min())

    def _pull_all(self, closed: Closed, pulls: Pulls) -> bool:
        """Run directions into ``pulls`` until all is decided; True if one diverged."""
        diverged, holds, stays = False, True, True
        for k, axis in enumerate(AXES):
            pulls.moved[k], pulls.depth[k] = self._pull(axis, closed)
            if self._wild():
                diverged, pulls.held[k], pulls.moved[k] = True, 0, np.nan
            else:
                pulls.touches[k] = self._links_touching(self._m, self._data) > 0
                pulls.held[k] = self._bounds.held(pulls.moved[k], pulls.touches[k], pulls.depth[k])
            holds, stays = holds and pulls.held[k] == 1, stays and self._bounds.stays(pulls.moved[k])
            if not (self._all or holds or stays):
                break
        return diverged

    def _pull(self, axis: np.ndarray, closed: Closed) -> tuple[np.ndarray, float]:
        """Load one direction [hand base frame].

        Returns:
            How far each object moved at worst, (O, 2) [m], [rad], and the deepest penetration of any [m].
        """
        lib, data, model = self._lib, self._data, self._model
        lib.mj_setState(self._m, data, self._state, lib.mjtState.mjSTATE_INTEGRATION)
        R_base = data.xmat[model.base_body].reshape(3, 3)
        data.xfrc_applied[model.object_body, :3] = model.forces[:, None] * (R_base @ axis)
        worst, depth = closed.moved, closed.depth
        total = max(1, round(self._protocol.hold / self._m.opt.timestep))
        done, before = 0, self._moved()
        while done < total:
            steps = min(self._chunk, total - done)
            self._step(steps)
            done += steps
            now = self._moved()
            worst = np.maximum(worst, now)
            if self._wild():
                break
            depth = max(depth, self._deepest())
            if self._bounds.lost(worst):
                break
            near = self._settled_stop and self._bounds.near(before, now, (total - done) / steps)
            if near and self._bounds.held(worst, self._links_touching(self._m, self._data) > 0, depth):
                break
            before = now
        return worst, depth

    def _step(self, steps: int) -> None:
        self._lib.mj_step(self._m, self._data, steps)
        self.steps += steps

    def _place(self, m: Any, data: Any, q: np.ndarray, poses: np.ndarray) -> None:
        """Hand at q (K,), objects at poses (O, 7) in the base frame, everything at rest; contacts are found."""
        model, lib = self._model, self._lib
        lib.mj_resetData(m, data)
        data.qpos[model.joint_address] = model.joint_matrix @ q + model.joint_offset
        data.ctrl[:] = self._model.controls(q)
        lib.mj_kinematics(m, data)
        at, turn = np.zeros(3), np.zeros(4)
        base = model.base_body
        for address, pose in zip(model.object_address, poses.astype(float), strict=True):
            lib.mju_mulPose(at, turn, data.xpos[base], data.xquat[base], pose[:3], pose[3:])
            data.qpos[address] = [*at, *(turn / np.linalg.norm(turn))]
        lib.mj_kinematics(m, data)
        lib.mj_comPos(m, data)
        lib.mj_collision(m, data)

    def _look_at_q(self, rows: GraspRows, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Contact points on their links at q, (O, C, 3) in body frames [m], and links within 1 mm of each object."""
        model, data = self._model, self._near
        self._place(model.mujoco_near, data, rows.q[i], rows.object_pose[i])
        body = model.link_body[rows.contact_links[i]]  # (O, C)
        T = data.xmat[model.object_body].reshape(-1, 3, 3)
        world = data.xpos[model.object_body][:, None] + rows.contact_points[i] @ T.transpose(0, 2, 1)
        R = data.xmat[body].reshape(*body.shape, 3, 3)
        points = np.einsum("ocji,ocj->oci", R, world - data.xpos[body])
        return points, self._links_touching(model.mujoco_near, data)

    def _slip(self, rows: GraspRows, i: int, points: np.ndarray) -> float:
        """How far the points of links are from the contact points that they made at q [m], largest; NaN: none."""
        data, model = self._data, self._model
        links = rows.contact_links[i]  # (O, C)
        if not (links >= 0).any():
            return np.nan
        self._lib.mj_kinematics(self._m, data)
        body = model.link_body[links]
        R = data.xmat[body].reshape(*body.shape, 3, 3)
        world = data.xpos[body] + np.einsum("ocij,ocj->oci", R, points)
        T = data.xmat[model.object_body].reshape(-1, 3, 3)
        seen = (world - data.xpos[model.object_body][:, None]) @ T
        return float(np.linalg.norm(seen - rows.contact_points[i], axis=2)[links >= 0].max())

    def _links_touching(self, m: Any, data: Any) -> np.ndarray:
        """Number of the hand's bodies in contact with each object, (O,)."""
        return links_touching(m.geom_bodyid[data.contact.geom], self._model.object_body, m.nbody)[0]

    def _deepest(self) -> float:
        """Deepest penetration of any object, in a link or in another object [m]."""
        contact = self._data.contact
        return max(0.0, -float(contact.dist[self._of_object[contact.geom].any(1)].min(initial=0.0)))

    def _objects(self) -> np.ndarray:
        """Poses of the objects, (O, 7)."""
        return self._data.qpos[self._model.object_address]

    def _moved(self) -> np.ndarray:
        """How far each object is from its start: displacement [m] and rotation [rad], (O, 2)."""
        return moved(self._objects(), self._start, self._model.centers)

    def _wild(self) -> bool:
        """True if the simulation has diverged."""
        return not np.abs(self._data.qvel).max() < WILD or not np.isfinite(self._data.qpos).all()

"""Many copies of one scene on one device, stepped together by MuJoCo Warp."""

from copy import copy
from typing import Any

import numpy as np
import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.fetch import to_numpy
from lgrasp.simulate.builder import import_mujoco, import_mujoco_warp
from lgrasp.simulate.model import Model
from lgrasp.simulate.verdict import CHUNK, WILD, links_touching, moved

wp.set_module_options(KERNEL_OPTIONS)

_CONTACTS_PER_OBJECT = 96  # per world and object, on average
_BUFFER_WARNINGS = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")  # buffers that may be full
_CONSTRAINTS_PER_OBJECT = 640  # rows per world and object: four a contact, limits, couplings


@wp.struct
class _Targets:
    """Where the drives of W worlds go, and how far they are."""

    start: wp.array2d(dtype=wp.float32)  # (W, nu)
    end: wp.array2d(dtype=wp.float32)  # (W, nu)
    step: wp.array(dtype=wp.float32)  # (W,) steps since the start
    ramp: wp.float32  # steps from start to end


@wp.kernel
def _drive(targets: _Targets, ctrl_out: wp.array2d(dtype=wp.float32)):
    """Targets of the next step, evenly from start to end over ``ramp`` steps.

    Args:
        ctrl_out: (W, nu).
    """
    world, u = wp.tid()
    share = wp.min((targets.step[world] + 1.0) / targets.ramp, 1.0)
    ctrl_out[world, u] = targets.start[world, u] + (targets.end[world, u] - targets.start[world, u]) * share


@wp.kernel
def _count(targets_out: _Targets):
    """One step more."""
    world = wp.tid()
    targets_out.step[world] = targets_out.step[world] + 1.0


class Worlds:
    """W copies of one scene; their state is set and read as NumPy arrays, and stepped a chunk at a time."""

    def __init__(self, model: Model, worlds: int, device: str) -> None:
        mujoco, mujoco_warp = import_mujoco(), import_mujoco_warp()
        self._lib: Any = mujoco_warp
        self._model, self._device, self.worlds = model, wp.get_device(device), worlds
        m = copy(model.mujoco)
        if len(model.object_body) > 1:  # objects that press on each other: in single precision Newton's method fails
            m.opt.solver = mujoco.mjtSolver.mjSOL_CG
        m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # it never resets by itself
        with wp.ScopedDevice(self._device):
            self._m = mujoco_warp.put_model(m)
            self._m.opt.warn_overflow = 0  # reported by :meth:`overflowed`
            room = {
                "nconmax": _CONTACTS_PER_OBJECT * len(model.object_body),
                "njmax": _CONSTRAINTS_PER_OBJECT * len(model.object_body),
            }
            self._d = mujoco_warp.make_data(m, nworld=worlds, **room)
            self._targets = t = _Targets()
            t.start, t.end, t.step = (wp.zeros((worlds, m.nu)[:n], dtype=wp.float32) for n in (2, 2, 1))
            t.ramp = float(max(1, round(model.protocol.phase / m.opt.timestep)))
        d = self._d
        self._state = {"qpos": d.qpos, "qvel": d.qvel, "warm": d.qacc_warmstart, "force": d.xfrc_applied}
        self._state |= {"start": t.start, "end": t.end, "step": t.step}
        self.chunk = max(1, round(CHUNK / m.opt.timestep))
        self._graph: Any = None
        self._full = sum(int(mujoco_warp.OverflowType[name]) for name in _BUFFER_WARNINGS)
        self.steps = 0
        self._compile()

    def _compile(self) -> None:
        """Compile what a step needs, and record it on a GPU; the state stays."""
        saved = self.state()
        with wp.ScopedDevice(self._device):
            self._one_step()
            if self._device.is_cuda:
                with wp.ScopedCapture() as capture:
                    self._one_step()
                self._graph = capture.graph
        self.restore(saved)
        self._d.overflow.zero_()

    def advance(self) -> None:
        """Step every world through one chunk."""
        with wp.ScopedDevice(self._device):
            for _ in range(self.chunk):
                if self._graph is None:
                    self._one_step()
                else:
                    wp.capture_launch(self._graph)
        self.steps += self.chunk * self.worlds

    def _one_step(self) -> None:
        wp.launch(_drive, self._d.ctrl.shape, [self._targets], [self._d.ctrl])
        wp.launch(_count, self.worlds, [], [self._targets])
        self._lib.step(self._m, self._d)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that decides what comes next, one row a world."""
        return {name: to_numpy(a) for name, a in self._state.items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Inverse of :meth:`state`."""
        for name, a in self._state.items():
            a.assign(state[name])

    def moved(self, state: dict[str, np.ndarray], home: np.ndarray) -> np.ndarray:
        """How far objects are from where they started: displacement [m] and rotation [rad], (worlds, O, 2).

        Args:
            home: poses at the start, (worlds, O, 7).
        """
        return moved(state["qpos"][:, self._model.object_address], home, self._model.centers)

    @staticmethod
    def wild(state: dict[str, np.ndarray]) -> np.ndarray:
        """(worlds,) bool: where the simulation has diverged."""
        return ~(np.abs(state["qvel"]).max(1) < WILD) | ~np.isfinite(state["qpos"]).all(1)

    def overflowed(self) -> np.ndarray:
        """(worlds,) bool: where a buffer was full since the last call, so that the state there is worth nothing."""
        full = (to_numpy(self._d.overflow) & self._full) != 0
        self._d.overflow.zero_()
        return full

    def contacts(self) -> tuple[np.ndarray, np.ndarray]:
        """Number of links that touch each object, (worlds, O), and deepest penetration of any object [m], (worlds,)."""
        d, m = self._d, self._model.mujoco
        n = min(int(to_numpy(d.nacon)[0]), d.naconmax)
        geoms, world, dist = (to_numpy(a[:n]) for a in (d.contact.geom, d.contact.worldid, d.contact.dist))
        close = (dist < 0) & (geoms >= 0).all(1)
        bodies, world, dist = m.geom_bodyid[geoms[close]], world[close], dist[close]
        links = links_touching(bodies, self._model.object_body, m.nbody, world, self.worlds)
        of_object = np.isin(bodies, self._model.object_body).any(1)
        depth = np.zeros(self.worlds)
        np.maximum.at(depth, world[of_object], -dist[of_object])
        return links, depth

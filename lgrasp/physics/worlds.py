"""Many copies of one scene on one device, stepped together by MuJoCo Warp."""

from copy import copy
from typing import Any

import numpy as np
import warp as wp

from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.errors import PhysicsError
from lgrasp.physics.model import Model, import_mujoco
from lgrasp.physics.trial import CHUNK

__all__ = ["Worlds"]

wp.set_module_options(KERNEL_OPTIONS)

_CONTACTS = 96  # per world, on average
_FULL = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")  # buffers that may be full
_CONSTRAINTS = 640  # rows per world: four a contact, limits, couplings


@wp.kernel
def _drive(
    start: wp.array2d(dtype=wp.float32),
    end: wp.array2d(dtype=wp.float32),
    ramp: wp.float32,
    step: wp.array(dtype=wp.float32),
    ctrl_out: wp.array2d(dtype=wp.float32),
):
    """Targets of the next step, evenly from start to end over ``ramp`` steps."""
    world, u = wp.tid()
    share = wp.min((step[world] + 1.0) / ramp, 1.0)
    ctrl_out[world, u] = start[world, u] + (end[world, u] - start[world, u]) * share


@wp.kernel
def _count(step_out: wp.array(dtype=wp.float32)):
    step_out[wp.tid()] = step_out[wp.tid()] + 1.0


class Worlds:
    """W copies of one scene; their state is set and read as NumPy arrays, and stepped a chunk at a time."""

    def __init__(self, model: Model, worlds: int, device: str) -> None:
        mujoco = import_mujoco()
        try:
            import mujoco_warp
        except ImportError:
            raise PhysicsError(
                'physics on a GPU needs MuJoCo Warp, which is not installed: pip install "lgrasp[sim,gpu-sim]"'
            ) from None
        self._lib: Any = mujoco_warp
        self._model, self._device, self.worlds = model, wp.get_device(device), worlds
        m = copy(model.mujoco)
        m.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # it never resets by itself
        with wp.ScopedDevice(self._device):
            self._m = mujoco_warp.put_model(m)
            self._m.opt.warn_overflow = 0  # said by :meth:`overflowed`
            self._d = mujoco_warp.make_data(m, nworld=worlds, nconmax=_CONTACTS, njmax=_CONSTRAINTS)
            shape = (worlds, m.nu)
            self._start, self._end, self._step = (wp.zeros(s, dtype=wp.float32) for s in (shape, shape, (worlds,)))
        self._ramp = float(max(1, round(model.protocol.phase / m.opt.timestep)))
        self.chunk = max(1, round(CHUNK / m.opt.timestep))
        self._graph: Any = None
        self._full = sum(int(mujoco_warp.OverflowType[name]) for name in _FULL)
        self.steps = 0

    def advance(self) -> None:
        """Step every world through one chunk."""
        with wp.ScopedDevice(self._device):
            if self._graph is None and self._device.is_cuda:
                saved = self.state()
                self._one_step()  # compiles what is needed
                self.restore(saved)
                with wp.ScopedCapture() as capture:
                    self._one_step()
                self._graph = capture.graph
            for _ in range(self.chunk):
                if self._graph is None:
                    self._one_step()
                else:
                    wp.capture_launch(self._graph)
        self.steps += self.chunk * self.worlds

    def _one_step(self) -> None:
        wp.launch(_drive, self._start.shape, [self._start, self._end, self._ramp, self._step], [self._d.ctrl])
        wp.launch(_count, self.worlds, [], [self._step])
        self._lib.step(self._m, self._d)

    def state(self) -> dict[str, np.ndarray]:
        """Everything that decides what comes next, one row a world."""
        d = self._d
        arrays = {"qpos": d.qpos, "qvel": d.qvel, "warm": d.qacc_warmstart, "force": d.xfrc_applied}
        own = {"start": self._start, "end": self._end, "step": self._step}
        return {name: a.numpy().copy() for name, a in (arrays | own).items()}

    def restore(self, state: dict[str, np.ndarray]) -> None:
        """Inverse of :meth:`state`."""
        d = self._d
        arrays = {"qpos": d.qpos, "qvel": d.qvel, "warm": d.qacc_warmstart, "force": d.xfrc_applied}
        own = {"start": self._start, "end": self._end, "step": self._step}
        for name, a in (arrays | own).items():
            a.assign(state[name])

    def overflowed(self) -> np.ndarray:
        """(worlds,) bool: where a buffer was full since the last call, so that the state there is worth nothing."""
        full = (self._d.overflow.numpy() & self._full) != 0
        self._d.overflow.zero_()
        return full

    def touching(self) -> np.ndarray:
        """Number of links that touch the object, (worlds,)."""
        d, m = self._d, self._model.mujoco
        n = min(int(d.nacon.numpy()[0]), d.naconmax)
        geoms, world = d.contact.geom.numpy()[:n], d.contact.worldid.numpy()[:n]
        close = (d.contact.dist.numpy()[:n] < 0) & (geoms >= 0).all(1)
        bodies, world = m.geom_bodyid[geoms[close]], world[close]
        with_object = (bodies == self._model.object_body).any(1)
        other = np.where(bodies[:, 0] == self._model.object_body, bodies[:, 1], bodies[:, 0])
        pairs = np.unique(np.column_stack([world[with_object], other[with_object]]), axis=0)
        return np.bincount(pairs[:, 0], minlength=self.worlds) if len(pairs) else np.zeros(self.worlds, int)

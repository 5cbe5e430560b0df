"""Many copies of one scene on one device, stepped together by MuJoCo Warp."""

from collections.abc import Iterator
from copy import copy
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.fetch import fetch
from lgrasp.runtime.kernels import load_launched
from lgrasp.runtime.optional import import_mujoco, import_mujoco_warp
from lgrasp.simulate.model import Model
from lgrasp.simulate.noslip import NoSlip
from lgrasp.simulate.verdict import CHUNK, WILD, moved

wp.set_module_options(KERNEL_OPTIONS)

# room per world and object:
_CONTACTS_PER_OBJECT = 64  # pairs of pieces that may touch, on average
_DEEP_PER_OBJECT = 24  # pairs that penetrate, on average
_CONSTRAINTS_PER_OBJECT = 256  # rows: four a contact, limits, couplings
_BUFFER_WARNINGS = ("NEFC", "NJMAX_NNZ", "BROADPHASE", "NARROWPHASE", "CCD", "EPA_HORIZON")  # buffers that may be full
_MOST_ITERATIONS = 20  # of Newton's method: all worlds wait for the slowest
_TOLERANCE = 1.0e-5  # at which it ends, in single precision


@wp.struct
class _Targets:
    """Where the drives of W worlds go, and how far they are."""

    start: wp.array2d(dtype=wp.float32)  # (W, nu)
    end: wp.array2d(dtype=wp.float32)  # (W, nu)
    step: wp.array2d(dtype=wp.float32)  # (W, 1) steps since the start
    ramp: wp.float32  # steps from start to end


@wp.struct
class _Owners:
    """What the bodies and their geoms belong to."""

    body: wp.array(dtype=wp.int32)  # (G,) of each geom
    number: wp.array(dtype=wp.int32)  # (B,) which object each body is, -1: none


@wp.struct
class _Touching:
    """What touches in W worlds; O objects, B bodies."""

    links: wp.array3d(dtype=wp.uint8)  # (W, O, B) 1: this body, no object itself, touches the object
    depth: wp.array2d(dtype=wp.float32)  # (W, 2) deepest penetration of any object, of anything [m]


@wp.kernel
def _drive(targets: _Targets, ctrl_out: wp.array2d(dtype=wp.float32)):
    """Targets of the next step, evenly from start to end over ``ramp`` steps.

    Args:
        ctrl_out: (W, nu).
    """
    world, u = wp.tid()
    share = wp.min((targets.step[world, 0] + 1.0) / targets.ramp, 1.0)
    ctrl_out[world, u] = targets.start[world, u] + (targets.end[world, u] - targets.start[world, u]) * share


@wp.kernel
def _count(targets_out: _Targets):
    """One step more."""
    world = wp.tid()
    targets_out.step[world, 0] = targets_out.step[world, 0] + 1.0


@wp.kernel
def _take(
    rows: wp.array(dtype=wp.int32),
    kept: wp.array2d(dtype=wp.float32),
    now_out: wp.array2d(dtype=wp.float32),
):
    """Rows that were kept become those of worlds.

    Args:
        rows: (W,) which one each world takes, -1: none.
        kept: (N, K).
        now_out: (W, K).
    """
    world, k = wp.tid()
    if rows[world] >= 0:
        now_out[world, k] = kept[rows[world], k]


@wp.kernel
def _push(
    rows: wp.array(dtype=wp.int32),
    bodies: wp.array(dtype=wp.int32),
    forces: wp.array3d(dtype=wp.float32),
    applied_out: wp.array2d(dtype=wp.float32),
):
    """Forces on the centres of mass of bodies, in the worlds that take rows.

    Args:
        rows: (W,) -1: the world stays as it is.
        bodies: (O,)
        forces: (W, O, 3) [N], world frame.
        applied_out: (W, 6 B) force and torque on each body.
    """
    world, o, k = wp.tid()
    if rows[world] >= 0:
        applied_out[world, 6 * bodies[o] + k] = forces[world, o, k]


@wp.kernel
def _touch(
    geoms: wp.array(dtype=wp.vec2i),
    worlds: wp.array(dtype=wp.int32),
    distances: wp.array(dtype=wp.float32),
    count: wp.array(dtype=wp.int32),
    most: wp.float32,
    owners: _Owners,
    touching_out: _Touching,
):
    """Note each contact below a distance.

    Args:
        geoms: (C,) both, of each contact.
        worlds: (C,)
        distances: (C,) below 0 if they penetrate [m].
        count: (1,) contacts in all.
        most: [m]
    """
    contact = wp.tid()
    if contact >= count[0] or distances[contact] >= most:
        return
    pair, world, depth = geoms[contact], worlds[contact], -distances[contact]
    if pair[0] < 0 or pair[1] < 0:
        return
    a, b = owners.body[pair[0]], owners.body[pair[1]]
    of_a, of_b = owners.number[a], owners.number[b]
    wp.atomic_max(touching_out.depth, world, 1, depth)
    if of_a >= 0 or of_b >= 0:
        wp.atomic_max(touching_out.depth, world, 0, depth)
    if of_a >= 0 and of_b < 0:
        touching_out.links[world, of_a, b] = wp.uint8(1)
    if of_b >= 0 and of_a < 0:
        touching_out.links[world, of_b, a] = wp.uint8(1)


Kept = tuple[wp.array, ...]
"""Everything that decides what comes next, one row a world, on the device."""


class Sighting(NamedTuple):
    """W worlds as they are now."""

    qpos: np.ndarray
    """(W, nq)"""
    velocity: np.ndarray
    """(W, nv)"""
    links: np.ndarray
    """Links that touch each object, (W, O)."""
    depth: np.ndarray
    """Deepest penetration of any object [m], (W,)."""
    full: np.ndarray
    """(W,) bool: a buffer was full since the last look, so that the state is worth nothing."""

    @property
    def wild(self) -> np.ndarray:
        """(W,) bool: where the simulation has diverged."""
        return ~(np.abs(self.velocity).max(1) < WILD) | ~np.isfinite(self.qpos).all(1)


class Placed(NamedTuple):
    """A model on a device, which many may share."""

    host: Any
    """MuJoCo's own."""
    far: Any
    near: Any
    """In which hand and objects touch within 1 mm."""

    @classmethod
    def of(cls, model: Model, device: str) -> "Placed":
        mujoco, mujoco_warp = import_mujoco(), import_mujoco_warp()
        m, near = copy(model.mujoco), copy(model.mujoco_near)
        for made in (m, near):
            made.opt.jacobian = mujoco.mjtJacobian.mjJAC_SPARSE  # a contact moves one finger
            if len(model.object_body) > 1:  # which press on each other: in single precision Newton's method fails
                made.opt.solver = mujoco.mjtSolver.mjSOL_CG
            else:
                made.opt.iterations = min(made.opt.iterations, _MOST_ITERATIONS)
                made.opt.tolerance = max(made.opt.tolerance, _TOLERANCE)
                made.opt.noslip_iterations = 0  # :class:`NoSlip` does it, faster
            made.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # it never resets by itself
        with wp.ScopedDevice(device):
            placed = cls(m, mujoco_warp.put_model(m), mujoco_warp.put_model(near))
        for one in placed[1:]:
            one.opt.warn_overflow = 0  # :class:`Sighting` tells
        return placed


class Worlds:
    """W copies of one scene, stepped a chunk at a time; states are kept and taken up again on the device."""

    def __init__(self, model: Model, placed: Placed, worlds: int, device: str) -> None:
        mujoco_warp = import_mujoco_warp()
        self._lib: Any = mujoco_warp
        self._model, self._device, self.worlds = model, wp.get_device(device), worlds
        m, self._m, self._near = placed
        with wp.ScopedDevice(self._device):
            per = {"nconmax": _CONTACTS_PER_OBJECT, "nccdmax": _DEEP_PER_OBJECT, "njmax": _CONSTRAINTS_PER_OBJECT}
            room = {name: number * len(model.object_body) for name, number in per.items()}
            self._d = d = mujoco_warp.make_data(m, nworld=worlds, **room)
            sweeps = 0 if m.opt.noslip_iterations else model.protocol.noslip  # else the library does them
            self._noslip = NoSlip(self._m, d, sweeps) if sweeps else None
            self._targets = t = _Targets()
            t.start, t.end, t.step = (wp.zeros((worlds, n), dtype=wp.float32) for n in (m.nu, m.nu, 1))
            t.ramp = float(model.steps(model.protocol.phase))
            self._rows = wp.empty(worlds, dtype=wp.int32)
            self._bodies = wp.array(model.object_body, dtype=wp.int32)
            self._forces = wp.empty((worlds, len(model.object_body), 3), dtype=wp.float32)
            self._owners, number = _Owners(), np.full(m.nbody, -1)
            number[model.object_body] = np.arange(len(model.object_body))
            self._owners.body = wp.array(m.geom_bodyid, dtype=wp.int32)
            self._owners.number = wp.array(number, dtype=wp.int32)
            self._touching = _Touching()
            self._touching.links = wp.zeros((worlds, len(model.object_body), m.nbody), dtype=wp.uint8)
            self._touching.depth = wp.zeros((worlds, 2), dtype=wp.float32)
            force = d.xfrc_applied
            self._applied = wp.array(ptr=force.ptr, dtype=wp.float32, shape=(worlds, 6 * m.nbody), copy=False)
        self.state: Kept = (d.qpos, d.qvel, d.qacc_warmstart, self._applied, t.start, t.end, t.step)
        self.chunk = model.steps(CHUNK)
        self._graph: Any = None
        self._full = sum(int(mujoco_warp.OverflowType[name]) for name in _BUFFER_WARNINGS)
        self._compile()

    def _compile(self) -> None:
        """Compile what a step needs, and record it on a GPU; the state stays."""
        before = self.keep()
        with wp.ScopedDevice(self._device):
            load_launched(self._one_step, str(self._device))
            self._one_step()
            if self._device.is_cuda:
                with wp.ScopedCapture() as capture:
                    self._one_step()
                self._graph = capture.graph
        self.take(before, np.arange(self.worlds))
        self._d.overflow.zero_()

    def chunks(self, seconds: float) -> Iterator[int]:
        """Steps of all chunks of some time, the last of which may be shorter."""
        steps = self._model.steps(seconds)
        return (min(self.chunk, steps - done) for done in range(0, steps, self.chunk))

    def advance(self, steps: int) -> None:
        """Step every world."""
        with wp.ScopedDevice(self._device):
            for _ in range(steps):
                if self._graph is None:
                    self._one_step()
                else:
                    wp.capture_launch(self._graph)

    def _one_step(self) -> None:
        wp.launch(_drive, self._d.ctrl.shape, [self._targets], [self._d.ctrl])
        wp.launch(_count, self.worlds, [], [self._targets])
        if self._noslip is None:
            self._lib.step(self._m, self._d)
        else:
            self._lib.forward(self._m, self._d)
            self._noslip.run()
            self._lib.mul_m(self._m, self._d, self._d.efc.Ma, self._d.qacc)  # what the integrator starts from
            self._lib.implicit(self._m, self._d)

    def begin(self, qpos: np.ndarray) -> None:
        """Everything at rest at qpos (W, nq), the drives' targets 0."""
        for a in self.state:
            a.zero_()
        self._d.qpos.assign(qpos)

    def drive(self, start: np.ndarray, end: np.ndarray) -> None:
        """Targets of the drives from now on, (W, nu) each [rad or m]: from one to the other."""
        self._targets.start.assign(start)
        self._targets.end.assign(end)
        self._targets.step.zero_()

    def keep(self) -> Kept:
        """A copy of everything that decides what comes next, one row a world."""
        return tuple(wp.clone(a) for a in self.state)

    def take(self, kept: Kept, rows: np.ndarray) -> None:
        """Go on from rows (W,) of what these or other worlds have kept, where they are not -1."""
        self._rows.assign(rows.astype(np.int32))
        for a, now in zip(kept, self.state, strict=True):
            wp.launch(_take, now.shape, [self._rows, a], [now], device=self._device)

    def states(self) -> list[np.ndarray]:
        """Positions (W, nq), velocities (W, nv), the solver's last accelerations (W, nv) and targets (W, nu)."""
        return fetch([*self.state[:3], self._targets.end])

    def hold(self, rows: np.ndarray, forces: np.ndarray) -> None:
        """In worlds whose row (W,) is not -1 the targets stay at their ends, and forces (W, O, 3) [N] pull from now on
        at the centres of mass of the objects."""
        self._rows.assign(rows.astype(np.int32))
        self._forces.assign(forces)
        t = self._targets
        wp.launch(_push, forces.shape, [self._rows, self._bodies, self._forces], [self._applied], device=self._device)
        own = wp.array(np.where(rows >= 0, np.arange(self.worlds), -1), dtype=wp.int32, device=self._device)
        wp.launch(_take, t.start.shape, [own, t.end], [t.start], device=self._device)

    def place(self, qpos: np.ndarray, *, near: bool = False) -> None:
        """Everything at qpos (W, nq), with the contacts there; nothing moves.

        Args:
            near: hand and objects touch within 1 mm.
        """
        self._d.qpos.assign(qpos)
        model = self._near if near else self._m
        with wp.ScopedDevice(self._device):
            self._lib.kinematics(model, self._d)
            self._lib.collision(model, self._d)

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (W, B, 3) [m] and rotations (W, B, 3, 3) of the bodies in the world."""
        with wp.ScopedDevice(self._device):
            self._lib.kinematics(self._m, self._d)
        at, turn = fetch([self._d.xpos, self._d.xmat])
        return at, turn

    def touching(self, most: float = 0.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Links that are nearer than ``most`` [m] to each object (W, O); deepest penetration of any object, and of
        anything [m], (W, 2); where a buffer was full since the last call (W,)."""
        d, seen = self._d, self._touching
        seen.links.zero_()
        seen.depth.zero_()
        contact = d.contact
        listed = [contact.geom, contact.worldid, contact.dist, d.nacon, most, self._owners]
        wp.launch(_touch, d.naconmax, listed, [seen], device=self._device)
        links, depth, full = fetch([seen.links, seen.depth, d.overflow])
        d.overflow.zero_()
        return links.sum(2, dtype=int), depth.astype(float), (full & self._full) != 0

    def look(self) -> Sighting:
        """The worlds after a chunk."""
        links, depth, full = self.touching()
        qpos, velocity = fetch([self._d.qpos, self._d.qvel])
        return Sighting(qpos, velocity, links, depth[:, 0], full)

    def moved(self, qpos: np.ndarray, home: np.ndarray) -> np.ndarray:
        """How far objects are from where they started: displacement [m] and rotation [rad], (W, O, 2).

        Args:
            home: poses at the start, (W, O, 7).
        """
        return moved(qpos[:, self._model.object_address], home)

"""Verdicts of many grasps at once with MuJoCo Warp: worlds side by side on one device."""

import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.model import Model
from lgrasp.simulate.trial import Trial
from lgrasp.simulate.verdict import AXES, CHUNK, Bounds, Closed, Look, Pulls, Verdict, at_rest, conclude
from lgrasp.simulate.worlds import Worlds


@dataclass
class _Closing:
    """Hands of n grasps that close, and what has happened until now."""

    state: dict[str, np.ndarray]
    home: np.ndarray
    """Poses of the objects at the start, (worlds, O, 7)."""
    depth: np.ndarray
    """Deepest penetration of any object [m], (n,)."""
    worst: np.ndarray
    """Displacement [m] and rotation [rad] of each object at worst, (n, O, 2)."""
    contacts: np.ndarray
    """Links on the object that the fewest touch, before the squeeze, (n,)."""
    wild: np.ndarray
    """Diverged, (n,)."""
    full: np.ndarray
    """More contacts than there was room for, at any time, (n,)."""


class WorldTrials:
    """The same trials as :class:`Trial`, many at a time on one device.

    Its kernels are compiled when it is made; one thread at a time runs it. A grasp whose world needs more contacts than
    there is room for is judged by :class:`Trial` instead.

    Args:
        device: Warp device.
        worlds: simulated at a time.
        all_directions, settled_stop: as of :class:`Trial`.
    """

    def __init__(
        self,
        model: Model,
        device: str,
        *,
        worlds: int = 4096,
        threads: int = 2,
        all_directions: bool = False,
        settled_stop: bool = True,
    ) -> None:
        self._model, self._protocol = model, model.protocol
        self._sim = Worlds(model, worlds, device)
        self._few = Worlds(model, max(1, worlds // 8), device)
        self._threads, self._all, self._settled_stop = threads, all_directions, settled_stop
        self._spare = Trial(model, all_directions=all_directions, settled_stop=settled_stop)
        self._bounds, self._one = Bounds(model.protocol), threading.Lock()
        self._base = self._spare.base_rotation()

    @property
    def steps(self) -> int:
        """World-steps simulated so far."""
        return self._sim.steps + self._few.steps

    def run(self, rows: GraspRows, progress: Callable[[int, int], None] | None = None) -> list[Verdict]:
        """The verdicts of all rows."""
        found: list[Verdict] = []
        with self._one:
            for first in range(0, len(rows), self._sim.worlds):
                found += self._block(rows, np.arange(first, min(first + self._sim.worlds, len(rows))))
                if progress:
                    progress(len(found), sum(verdict.holds for verdict in found))
        return found

    def _block(self, rows: GraspRows, index: np.ndarray) -> list[Verdict]:
        n = len(index)
        looks = self._looks(rows, index)
        alive = np.array([look.depth for look in looks]) <= self._protocol.most_penetration
        hands = self._close(rows, index, looks)
        slip = self._slip(rows, index, looks, hands.state["qpos"][:n])
        rest = at_rest(hands.state["qvel"][:n, self._model.object_velocity])
        lost = hands.wild | self._bounds.lost(hands.worst)
        good = alive & ~lost
        hands.worst[hands.wild | ~alive] = np.nan
        pulls, ran_away = self._pull(hands, good)
        pulls.held[alive & lost] = 0
        pulls.moved[alive & lost] = hands.worst[alive & lost][:, None]

        def verdict(i: int) -> Verdict:
            if hands.full[i]:
                return self._spare.run(rows, int(index[i]))
            closed = Closed(
                int(hands.contacts[i]) if alive[i] else 0,
                float(slip[i]) if good[i] else np.nan,
                bool(good[i] and rest[i]),
                hands.worst[i],
                float(hands.depth[i]) if alive[i] else looks[i].object_depth,
            )
            own = Pulls(*(values[i] for values in pulls))
            return conclude(self._bounds, looks[i], closed, own, bool((hands.wild[i] and alive[i]) or ran_away[i]))

        return [verdict(i) for i in range(n)]

    def _looks(self, rows: GraspRows, index: np.ndarray) -> list[Look]:
        """What needs no simulation, by MuJoCo itself on several threads."""
        trials = [Trial(self._model) for _ in range(self._threads)]

        def look(part: int) -> list[Look]:
            return [trials[part].look(rows, int(i)) for i in index[part :: self._threads]]

        with ThreadPoolExecutor(self._threads) as pool:
            parts = list(pool.map(look, range(self._threads)))
        return [parts[k % self._threads][k // self._threads] for k in range(len(index))]

    def _close(self, rows: GraspRows, index: np.ndarray, looks: list[Look]) -> _Closing:
        """From the start to the squeeze, as of :class:`Trial`."""
        n = len(index)
        start = np.stack([look.qpos for look in looks])
        stops = [self._model.controls(q[index].astype(float)) for q in self._protocol.stops(rows)]
        state = self._sim.state()
        for name in ("qvel", "warm", "force", "step"):
            state[name][:] = 0
        state["qpos"][:n], state["qpos"][n:] = start, start[0]
        state["start"][n:] = state["end"][n:] = stops[0][0]
        home = state["qpos"][:, self._model.object_address]
        depth, no = np.array([look.object_depth for look in looks]), np.zeros(n, bool)
        hands = _Closing(state, home, depth, np.zeros((n, home.shape[1], 2)), np.zeros(n, int), no, no.copy())
        for a, b in pairwise(stops):
            if b is stops[-1]:  # the targets are q, the squeeze is next
                hands.contacts = self._touching_at_rest(hands, a)
            hands.state["start"][:n], hands.state["end"][:n], hands.state["step"][:] = a, b, 0
            self._sim.restore(hands.state)
            seconds = self._protocol.phase + (self._protocol.rest if b is stops[-1] else 0.0)
            for _ in range(max(1, round(seconds / CHUNK))):
                self._sim.advance()
                hands.state = self._sim.state()
                hands.worst = np.maximum(hands.worst, self._sim.moved(hands.state, hands.home)[:n])
                hands.wild |= self._sim.wild(hands.state)[:n]
                deep = np.maximum(hands.depth, self._sim.contacts()[1][:n])
                hands.depth = np.where(hands.wild, hands.depth, deep)
                hands.full |= self._sim.overflowed()[:n]
        return hands

    def _touching_at_rest(self, hands: _Closing, targets: np.ndarray) -> np.ndarray:
        """Links on the object that the fewest touch, (n,), once hands have caught up with their targets (n, nu)."""
        n = len(targets)
        hands.state["start"][:n] = hands.state["end"][:n] = targets
        self._sim.restore(hands.state)
        for _ in range(max(1, round(self._protocol.settle / CHUNK))):
            self._sim.advance()
        hands.full |= self._sim.overflowed()[:n]
        return self._sim.contacts()[0][:n].min(1)

    def _pull(self, hands: _Closing, good: np.ndarray) -> tuple[Pulls, np.ndarray]:
        """Every direction of every good grasp, in whatever world is free, and which diverged; as of :class:`Trial`."""
        n, sim, bodies, bounds = len(good), self._sim, self._model.object_body, self._bounds
        pulls = Pulls.of(n, len(bodies))
        ran_away, undecided = np.zeros(n, bool), np.ones((n, 2), bool)  # holds, stays
        waiting = [(int(i), k) for k in reversed(range(6)) for i in reversed(np.flatnonzero(good))]
        total = max(1, round(self._protocol.hold / CHUNK))
        job = np.full((sim.worlds, 2), -1)  # grasp and direction of each world
        done, depth = np.zeros(sim.worlds, int), np.zeros(sim.worlds)
        before, worst = np.zeros((2, sim.worlds, len(bodies), 2))
        state = {name: values.copy() for name, values in hands.state.items()}
        home = hands.home.copy()
        axes = AXES @ self._base.T
        while True:
            free = np.flatnonzero(job[:, 0] < 0)
            taken = []
            while waiting and len(taken) < len(free):
                i, k = waiting.pop()
                if self._all or undecided[i].any():
                    taken.append((i, k))
            fresh = free[: len(taken)]
            if taken:
                job[fresh] = taken
                i, k = job[fresh].T
                done[fresh], worst[fresh], depth[fresh], home[fresh] = 0, hands.worst[i], hands.depth[i], hands.home[i]
                for name, values in hands.state.items():
                    state[name][fresh] = values[i]
                state["start"][fresh], state["force"][fresh] = hands.state["end"][i], 0
                state["force"][fresh[:, None], bodies, :3] = self._model.forces[:, None] * axes[k][:, None]
                before[fresh] = sim.moved(state, home)[fresh]
            busy = np.flatnonzero(job[:, 0] >= 0)
            if not len(busy):
                return pulls, ran_away
            if not waiting and sim is self._sim and len(busy) <= self._few.worlds:  # stragglers
                sim, rows = self._few, np.resize(busy, self._few.worlds)
                state = {name: values[rows] for name, values in state.items()}
                job, done, depth, before, worst, home = (a[rows] for a in (job, done, depth, before, worst, home))
                job[len(busy) :] = -1
                busy, taken = np.arange(len(busy)), [(-1, -1)]
            if taken:
                sim.restore(state)
            sim.advance()
            state = sim.state()
            here, wild = sim.moved(state, home), sim.wild(state)
            links, deep = sim.contacts()
            worst, depth = np.maximum(worst, here), np.where(wild, depth, np.maximum(depth, deep))
            done += 1
            held = ~wild & bounds.held(worst, links > 0, depth)
            over = wild | bounds.lost(worst) | (done >= total)
            if self._settled_stop:
                over |= held & bounds.near(before, here, total - done)
            before = here
            short = busy[sim.overflowed()[busy]]
            hands.full[job[short, 0]] = True
            ended = busy[over[busy]]
            i, k = job[ended].T
            pulls.held[i, k], pulls.touches[i, k], pulls.depth[i, k] = held[ended], links[ended] > 0, depth[ended]
            pulls.moved[i, k] = np.where(wild[ended, None, None], np.nan, worst[ended])
            undecided[i, 0] &= held[ended]
            undecided[i, 1] &= bounds.stays(pulls.moved[i, k])
            ran_away[i[wild[ended]]] = True
            job[ended] = -1

    def _slip(self, rows: GraspRows, index: np.ndarray, looks: list[Look], qpos: np.ndarray) -> np.ndarray:
        trial = Trial(self._model)
        slips = (trial.slip_at(rows, int(i), look.points, q) for i, look, q in zip(index, looks, qpos, strict=True))
        return np.fromiter(slips, float, len(index))

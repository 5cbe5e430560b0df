"""Verdicts of many grasps at once with MuJoCo Warp: worlds side by side on one device."""

import math
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from lgrasp.geometry.poses import compose, pose_from_matrix
from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.model import Model
from lgrasp.simulate.slip import points_on_links, slips
from lgrasp.simulate.trial import Trial
from lgrasp.simulate.verdict import AXES, Bounds, Closed, Look, Pulls, Verdict, at_rest, conclude
from lgrasp.simulate.worlds import Kept, Placed, Sighting, Worlds

_SHARES = (4.0, 2.0, 1.0, 0.5, 0.25, 0.0625)
"""Worlds in which closed hands are pulled, over those in which they close: fewer and fewer, as directions end."""
_MOST_THREADS = 16
"""Of the CPU, which ends the last directions: more wait for each other, as Python runs between their steps."""
_FEW, _FEW_PER_THREAD = 64, 8
"""Directions that are the last: a GPU steps so few worlds no faster than thousands. No more for each thread."""
_WORLD_BYTES = 3.0e5
"""Of a GPU's memory, that a world takes for each object."""
_MOST_HANDS, _LEAST_HANDS = 8192, 256


def hands_at_once(rows: int, objects: int, free: float) -> int:
    """How many hands to close at a time, of so many rows with so many objects, in ``free`` bytes of memory."""
    fit = 0.5 * free / (_WORLD_BYTES * objects * (1 + sum(_SHARES)))
    return max(min(rows, _MOST_HANDS, int(fit)), _LEAST_HANDS)


@dataclass
class _Closing:
    """Hands of n grasps that close in W worlds, and what has happened until now."""

    home: np.ndarray
    """Poses of the objects at the start, (W, O, 7)."""
    depth: np.ndarray
    """Deepest penetration of any object [m], (n,)."""
    worst: np.ndarray
    """Displacement [m] and rotation [rad] of each object at worst, (n, O, 2)."""
    wild: np.ndarray
    """Diverged, (n,)."""
    full: np.ndarray
    """More contacts than there was room for, at any time, (n,)."""
    contacts: np.ndarray
    """Links on the object that the fewest touch, before the squeeze, (n,)."""
    now: Sighting
    """(W,)"""


class WorldTrials:
    """The same trials as :class:`Trial`, many at a time on one device.

    Its kernels are compiled when it is made; one thread at a time runs it. A grasp whose world needs more contacts than
    there is room for is judged by :class:`Trial` instead.

    Args:
        device: Warp device.
        worlds: hands closed at a time.
        threads: of the CPU, which ends the last directions, 16 at most.
        all_directions: as of :class:`Trial`.
    """

    def __init__(
        self, model: Model, device: str, *, worlds: int = 4096, threads: int = 2, all_directions: bool = False
    ) -> None:
        self._model, self._protocol = model, model.protocol
        placed = Placed.of(model, device)
        self._sim = Worlds(model, placed, worlds, device)
        self._pulled = [Worlds(model, placed, max(1, int(worlds * share)), device) for share in _SHARES]
        self._every = all_directions
        self._few = min(_FEW, _FEW_PER_THREAD * threads)
        self._spare = [Trial(model, all_directions=all_directions) for _ in range(min(threads, _MOST_THREADS))]
        self._bounds, self._one = Bounds(model.protocol), threading.Lock()
        at, turn = (a[0, model.base_body].astype(float) for a in self._sim.frames())
        T = np.block([[turn, at[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])
        self._base, self._base_rotation = pose_from_matrix(T[None])[0], turn

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
        n, links, points = len(index), rows.contact_links[index], rows.contact_points[index]
        look, full = self._look(rows, index)
        alive = look.depth <= self._protocol.most_penetration
        hands = self._close(rows, index, look)
        hands.full |= full
        kept, (at, turn) = self._sim.keep(), self._sim.frames()
        slip = slips(self._model, (at[:n], turn[:n]), links, look.points, points)
        rest = at_rest(hands.now.velocity[:n, self._model.object_velocity])
        lost = hands.wild | self._bounds.lost(hands.worst)
        good = alive & ~lost
        hands.worst[hands.wild | ~alive] = np.nan
        pulls, ran_away = self._pull(hands, kept, good)
        pulls.held[alive & lost] = 0
        pulls.moved[alive & lost] = hands.worst[alive & lost][:, None]
        closed = Closed(
            np.where(alive, hands.contacts, 0),
            np.where(good, slip, np.nan),
            good & rest,
            hands.worst,
            np.where(alive, hands.depth, look.object_depth),
        )
        found = conclude(self._bounds, look, closed, pulls, (hands.wild & alive) | ran_away)
        own = [values for values in found if np.ndim(values)]
        verdicts = [Verdict(*values) for values in zip(*own, strict=True)]
        for i in np.flatnonzero(hands.full):
            verdicts[i] = self._spare[0].run(rows, int(index[i]))
        return verdicts

    def _look(self, rows: GraspRows, index: np.ndarray) -> tuple[Look, np.ndarray]:
        """What needs no simulation, and where there were more contacts than room, (n,)."""
        n, sim, pose = len(index), self._sim, rows.object_pose[index]
        sim.place(self._qpos(rows.q[index], pose), near=True)
        links, _, full = sim.touching(np.inf)
        at, turn = sim.frames()
        points = points_on_links(self._model, (at[:n], turn[:n]), rows.contact_links[index], rows.contact_points[index])
        start = self._qpos(self._protocol.stops(rows)[0][index], pose)
        sim.place(start)
        _, depth, too_full = sim.touching()
        return Look(points, links[:n], depth[:n, 1], depth[:n, 0], start[:n]), (full | too_full)[:n]

    def _qpos(self, q: np.ndarray, pose: np.ndarray) -> np.ndarray:
        """State of all worlds, (W, nq), of hands at q (n, K), objects at poses (n, O, 7); the rest are as the first."""
        model = self._model
        qpos = np.tile(model.mujoco.qpos0, (self._sim.worlds, 1))
        qpos[: len(q), model.joint_address] = q @ model.joint_matrix.T + model.joint_offset
        qpos[: len(q), model.object_address] = compose(self._base, pose)
        qpos[len(q) :] = qpos[0]
        return qpos

    def _filled(self, values: np.ndarray) -> np.ndarray:
        """Values of n grasps (n, ...) for all worlds (W, ...)."""
        return np.concatenate([values, np.repeat(values[:1], self._sim.worlds - len(values), 0)])

    def _close(self, rows: GraspRows, index: np.ndarray, look: Look) -> _Closing:
        """From the start to the squeeze, as of :class:`Trial`."""
        n, sim = len(index), self._sim
        stops = [self._filled(self._model.controls(q[index].astype(float))) for q in self._protocol.stops(rows)]
        start = self._filled(look.qpos)
        home = start[:, self._model.object_address]
        depth, none = look.object_depth, np.zeros(n, int)
        sim.begin(start)
        hands = _Closing(home, depth, np.zeros((n, home.shape[1], 2)), none > 0, none > 0, none, sim.look())
        for a, b in pairwise(stops):
            if b is stops[-1]:  # the targets are q, the squeeze is next
                hands.contacts = self._touching_at_rest(hands, a)
            sim.drive(a, b)
            seconds = self._protocol.phase + (self._protocol.rest if b is stops[-1] else 0.0)
            for steps in sim.chunks(seconds):
                sim.advance(steps)
                hands.now = now = sim.look()
                hands.worst = np.maximum(hands.worst, sim.moved(now.qpos, home)[:n])
                hands.wild |= now.wild[:n]
                hands.depth = np.where(hands.wild, hands.depth, np.maximum(hands.depth, now.depth[:n]))
                hands.full |= now.full[:n]
        return hands

    def _touching_at_rest(self, hands: _Closing, targets: np.ndarray) -> np.ndarray:
        """Links on the object that the fewest touch, (n,), once hands have caught up with their targets (W, nu); they
        then continue from the previous state."""
        n, sim = len(hands.full), self._sim
        before = sim.keep()
        sim.drive(targets, targets)
        for steps in sim.chunks(self._protocol.settle):
            sim.advance(steps)
        links, _, full = sim.touching()
        hands.full |= full[:n]
        sim.take(before, np.arange(sim.worlds))
        return links[:n].min(1)

    def _pull(self, hands: _Closing, kept: Kept, good: np.ndarray) -> tuple[Pulls, np.ndarray]:
        """Every direction of every good grasp, in whatever world is free, and which diverged; as of :class:`Trial`.

        Args:
            kept: state of the closed hands.
        """
        n, bounds, objects = len(good), self._bounds, len(self._model.object_body)
        pulls, wild_pulls = Pulls.of(n, objects), np.zeros((n, 6), bool)
        waiting = np.stack([np.tile(np.flatnonzero(good), 6), np.repeat(np.arange(6), good.sum())], 1)
        enough = sum(sim.worlds >= len(waiting) for sim in self._pulled)
        smaller = self._pulled[max(enough - 1, 0) :][::-1]
        sim = smaller.pop()
        steps = self._model.steps(self._protocol.hold)
        total = math.ceil(steps / sim.chunk)  # all whole: worlds are at different ones
        job: np.ndarray = np.full((sim.worlds, 2), -1)  # grasp and direction of each world
        done, depth = np.zeros(sim.worlds, int), np.zeros(sim.worlds)
        before, worst = np.zeros((2, sim.worlds, objects, 2))
        home, first = np.zeros((sim.worlds, *hands.home.shape[1:])), sim.moved(hands.now.qpos, hands.home)
        pull = self._model.forces[:, None] * (AXES @ self._base_rotation.T)[:, None]  # (6, O, 3)
        while True:
            late = self._late(pulls)
            waiting = waiting[~late[waiting[:, 0], waiting[:, 1]]]
            job[(job[:, 0] >= 0) & late[job[:, 0], job[:, 1]]] = -1  # ty: ignore[invalid-argument-type]
            free = np.flatnonzero(job[:, 0] < 0)
            taken, waiting = waiting[: len(free)], waiting[len(free) :]
            if len(taken):
                fresh = free[: len(taken)]
                job[fresh] = taken
                i, k = taken.T
                done[fresh], worst[fresh], depth[fresh], home[fresh] = 0, hands.worst[i], hands.depth[i], hands.home[i]
                before[fresh] = first[i]
                source = np.full(sim.worlds, -1)
                source[fresh] = i
                sim.take(kept, source)
                sim.hold(source, pull[job[:, 1]])
            busy = np.flatnonzero(job[:, 0] >= 0)
            if not len(busy):
                for values, none in zip(pulls, Pulls.of(n, objects), strict=True):
                    values[late] = none[late]
                return pulls, np.asarray((wild_pulls & ~late).any(1))
            if not len(waiting) and len(busy) <= self._few:
                so_far = [Closed(0, np.nan, False, worst[w], depth[w]) for w in busy]
                i, k = job[busy].T
                wild_pulls[i, k] = self._end_here(
                    sim, busy, job[busy], steps - done[busy] * sim.chunk, home[busy], so_far, pulls
                )
                job[busy] = -1
                continue
            while not len(waiting) and smaller and len(busy) <= smaller[-1].worlds:
                rows = np.resize(busy, smaller[-1].worlds)
                smaller[-1].take(sim.state, rows)
                sim = smaller.pop()
                job, done, depth, before, worst, home = (a[rows] for a in (job, done, depth, before, worst, home))
                job[len(busy) :] = -1
                busy = np.arange(len(busy))
            sim.advance(sim.chunk)
            now = sim.look()
            here, wild, touches = sim.moved(now.qpos, home), now.wild, now.links > 0
            worst, depth = np.maximum(worst, here), np.where(wild, depth, np.maximum(depth, now.depth))
            done += 1
            held = ~wild & bounds.held(worst, touches, depth)
            over = wild | bounds.lost(worst) | (done >= total) | (held & bounds.near(before, here, total - done))
            before = here
            hands.full[job[busy[now.full[busy]], 0]] = True
            ended = busy[over[busy]]
            i, k = job[ended].T
            pulls.held[i, k], pulls.touches[i, k], pulls.depth[i, k] = held[ended], touches[ended], depth[ended]
            pulls.moved[i, k] = np.where(wild[ended, None, None], np.nan, worst[ended])
            wild_pulls[i, k] = wild[ended]
            job[ended] = -1

    def _end_here(
        self,
        sim: Worlds,
        worlds: np.ndarray,
        jobs: np.ndarray,
        left: np.ndarray,
        home: np.ndarray,
        so_far: list[Closed],
        pulls: Pulls,
    ) -> np.ndarray:
        """End the directions of n worlds on the CPU, into ``pulls``; which diverged (n,).

        Args:
            jobs: grasp and direction (n, 2).
            left: steps (n,).
            home: poses of the objects at the start (n, O, 7).
        """
        state = [values[worlds] for values in sim.states()]
        wild, order, threads = np.zeros(len(worlds), bool), np.argsort(left), len(self._spare)

        def end(number: int) -> None:
            for w in order[number::threads]:
                i, k = jobs[w]
                load = np.tile(self._base_rotation @ AXES[k], (left[w], 1))
                own = Pulls(*(values[i] for values in pulls))
                begun = [values[w] for values in state]
                wild[w] = self._spare[number].go_on(begun, home[w], load, own, k, so_far[w])

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(end, range(threads)))
        return wild

    def _late(self, pulls: Pulls) -> np.ndarray:
        """Directions that one after the other would not be run, as all was decided before, (n, 6)."""
        lost = np.logical_or.accumulate(pulls.held == 0, 1)
        left = np.logical_or.accumulate((pulls.held >= 0) & ~self._bounds.stays(pulls.moved), 1)
        late = np.pad(lost & left, ((0, 0), (1, 0)))[:, :6]
        return late & (not self._every)

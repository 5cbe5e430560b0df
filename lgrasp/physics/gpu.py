"""Verdicts of many grasps at once with MuJoCo Warp: worlds side by side on one device."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from lgrasp.dataset.records import GraspRows
from lgrasp.physics.columns import stack_verdicts
from lgrasp.physics.model import Model
from lgrasp.physics.trial import AXES, CHUNK, REST, WILD, Trial, Verdict, is_safe
from lgrasp.physics.worlds import Worlds

__all__ = ["WorldTrials"]


class WorldTrials:
    """The same trials as :class:`Trial`, many at a time on one device.

    A grasp whose world needs more contacts than there is room for is judged by :class:`Trial` instead.

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
        self._limits = np.array([self._protocol.most_displacement, np.radians(self._protocol.most_rotation)])
        self._object = slice(model.object_address, model.object_address + 7)
        self._base = self._spare.base_rotation()

    @property
    def steps(self) -> int:
        """World-steps simulated so far."""
        return self._sim.steps + self._few.steps

    def run(self, rows: GraspRows, progress: Callable[[int, int], None] | None = None) -> dict[str, np.ndarray]:
        """Columns of the verdicts of all rows."""
        found: list[Verdict] = []
        for first in range(0, len(rows), self._sim.worlds):
            found += self._block(rows, np.arange(first, min(first + self._sim.worlds, len(rows))))
            if progress:
                progress(len(found), sum(verdict.holds for verdict in found))
        return stack_verdicts(self._protocol.name, found)

    def _block(self, rows: GraspRows, index: np.ndarray) -> list[Verdict]:
        n = len(index)
        looks = self._looks(rows, index)
        points, contact_at_q = [look[0] for look in looks], [look[1] for look in looks]
        depth = [look[2] for look in looks]
        start = np.stack([look[3] for look in looks])  # qpos at pregrasp
        alive = np.array(depth) <= self._protocol.most_penetration
        stops = [
            np.stack([self._model.controls(q[i].astype(float)) for i in index])
            for q in (rows.q_pregrasp, rows.q, rows.q_squeeze)
        ]
        state = self._sim.state()
        for name in ("qvel", "warm", "force", "step"):
            state[name][:] = 0
        state["qpos"][:n], state["start"][:n], state["end"][:n] = start, stops[0], stops[1]
        state["qpos"][n:], state["start"][n:], state["end"][n:] = start[0], stops[0][0], stops[0][0]
        origin = state["qpos"][:, self._object].copy()
        worst, wild, full = np.zeros((n, 2)), np.zeros(n, bool), np.zeros(n, bool)
        self._sim.restore(state)
        self._ramp(origin, worst, wild, full)
        state = self._sim.state()
        for _ in range(max(1, round(self._protocol.settle / CHUNK))):
            self._sim.advance()
        contacts = self._sim.touching()[:n]
        full |= self._sim.overflowed()[:n]
        state["start"][:n], state["end"][:n], state["step"][:] = stops[1], stops[2], 0
        self._sim.restore(state)
        self._ramp(origin, worst, wild, full)
        closed = self._sim.state()
        slip = self._slip(rows, index, points, closed["qpos"][:n])
        speed = closed["qvel"][:n, -6:]
        rest = (np.linalg.norm(speed[:, :3], axis=1) < REST[0]) & (np.linalg.norm(speed[:, 3:], axis=1) < REST[1])
        lost = wild | (worst > self._limits).any(1)
        directions, moved, ran_away = self._pull(closed, origin, worst, alive & ~lost, full)
        directions[alive & lost] = 0
        moved[alive & lost] = np.where(wild[:, None], np.nan, worst)[alive & lost][:, None]
        nan = np.nan
        return [
            self._spare.run(rows, int(index[i]))
            if full[i]
            else Verdict(
                bool((directions[i] == 1).all()),
                directions[i],
                moved[i, :, 0],
                moved[i, :, 1],
                float(slip[i]) if alive[i] and not lost[i] else nan,
                contact_at_q[i],
                int(contacts[i]) if alive[i] else 0,
                depth[i],
                bool(rest[i] and alive[i] and not lost[i]),
                bool((wild[i] and alive[i]) or ran_away[i]),
            )
            for i in range(n)
        ]

    def _looks(self, rows: GraspRows, index: np.ndarray) -> list[tuple[np.ndarray, int, float, np.ndarray]]:
        """What needs no simulation, by MuJoCo itself on several threads."""
        trials = [Trial(self._model) for _ in range(self._threads)]

        def look(part: int) -> list[tuple[np.ndarray, int, float, np.ndarray]]:
            return [trials[part].look(rows, int(i)) for i in index[part :: self._threads]]

        with ThreadPoolExecutor(self._threads) as pool:
            parts = list(pool.map(look, range(self._threads)))
        return [parts[k % self._threads][k // self._threads] for k in range(len(index))]

    def _ramp(self, origin: np.ndarray, worst: np.ndarray, wild: np.ndarray, full: np.ndarray) -> None:
        """One phase of closing; ``worst``, ``wild`` and ``full`` grow."""
        n = len(worst)
        for _ in range(max(1, round(self._protocol.phase / CHUNK))):
            self._sim.advance()
            state = self._sim.state()
            worst[:] = np.maximum(worst, self._moved(state["qpos"], origin)[:n])
            wild |= self._wild(state)[:n]
            full |= self._sim.overflowed()[:n]

    def _pull(
        self, closed: dict[str, np.ndarray], origin: np.ndarray, worst: np.ndarray, good: np.ndarray, full: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Every direction of every good grasp, in whatever world is free; as of :meth:`Trial.run`. ``full`` grows."""
        n, sim = len(good), self._sim
        directions, moved = np.full((n, 6), -1, np.int8), np.full((n, 6, 2), np.nan)
        ran_away, failed = np.zeros(n, bool), np.zeros(n, bool)
        waiting = [(int(i), k) for k in reversed(range(6)) for i in reversed(np.flatnonzero(good))]
        total = max(1, round(self._protocol.hold / CHUNK))
        job = np.full((sim.worlds, 2), -1)  # grasp and direction of each world
        done, before, now = np.zeros(sim.worlds, int), np.zeros((sim.worlds, 2)), np.zeros((sim.worlds, 2))
        state = {name: values.copy() for name, values in closed.items()}
        home = origin.copy()
        pulls = self._model.load.force * AXES @ self._base.T
        while True:
            free = np.flatnonzero(job[:, 0] < 0)
            taken = []
            while waiting and len(taken) < len(free):
                i, k = waiting.pop()
                if self._all or not failed[i]:
                    taken.append((i, k))
            fresh = free[: len(taken)]
            if taken:
                job[fresh] = taken
                i, k = job[fresh].T
                done[fresh], now[fresh], home[fresh] = 0, worst[i], origin[i]
                for name, values in closed.items():
                    state[name][fresh] = values[i]
                state["start"][fresh], state["force"][fresh] = closed["end"][i], 0
                state["force"][fresh, self._model.object_body, :3] = pulls[k]
                before[fresh] = self._moved(state["qpos"], home)[fresh]
            busy = np.flatnonzero(job[:, 0] >= 0)
            if not len(busy):
                return directions, moved, ran_away
            if not waiting and sim is self._sim and len(busy) <= self._few.worlds:  # stragglers
                sim, rows = self._few, np.resize(busy, self._few.worlds)
                state = {name: values[rows] for name, values in state.items()}
                job, done, before, now, home = job[rows], done[rows], before[rows], now[rows], home[rows]
                job[len(busy) :] = -1
                busy, taken = np.arange(len(busy)), [(-1, -1)]
            if taken:
                sim.restore(state)
            sim.advance()
            state = sim.state()
            here, wild = self._moved(state["qpos"], home), self._wild(state)
            now[:] = np.maximum(now, here)
            done += 1
            lost = wild | (now > self._limits).any(1)
            over = lost | (done >= total)
            if self._settled_stop:
                over |= is_safe(before.T, here.T, self._limits, total - done)
            before = here
            short = busy[sim.overflowed()[busy]]
            full[job[short, 0]] = True
            ended = busy[over[busy]]
            i, k = job[ended].T
            directions[i, k] = ~lost[ended]
            moved[i, k] = np.where(wild[ended][:, None], np.nan, now[ended])
            failed[i[lost[ended]]] = True
            ran_away[i[wild[ended]]] = True
            job[ended] = -1

    def _moved(self, qpos: np.ndarray, origin: np.ndarray) -> np.ndarray:
        """How far the objects are from their start: displacement [m] and rotation [rad], (worlds, 2)."""
        pose, center = qpos[:, self._object].astype(float), self._model.center
        start = origin.astype(float)

        def middle(p: np.ndarray) -> np.ndarray:
            t = 2 * np.cross(p[:, 4:], center)
            return p[:, :3] + center + p[:, 3:4] * t + np.cross(p[:, 4:], t)

        norm = np.linalg.norm(pose[:, 3:], axis=1) * np.linalg.norm(start[:, 3:], axis=1)
        cosine = np.abs((pose[:, 3:] * start[:, 3:]).sum(1)) / np.maximum(norm, 1e-12)
        turned = 2 * np.arccos(np.clip(cosine, 0, 1))
        return np.column_stack([np.linalg.norm(middle(pose) - middle(start), axis=1), turned])

    @staticmethod
    def _wild(state: dict[str, np.ndarray]) -> np.ndarray:
        return ~(np.abs(state["qvel"]).max(1) < WILD) | ~np.isfinite(state["qpos"]).all(1)

    def _slip(self, rows: GraspRows, index: np.ndarray, points: list[np.ndarray], qpos: np.ndarray) -> np.ndarray:
        trial = Trial(self._model)
        return np.array([trial.slip_at(rows, int(i), p, q) for i, p, q in zip(index, points, qpos, strict=True)])

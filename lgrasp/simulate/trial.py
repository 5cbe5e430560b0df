"""One grasp in a simulator: close the hand once, then pull the objects in each direction from that same state."""

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.draws import draw_of, tune
from lgrasp.simulate.engines import make_world
from lgrasp.simulate.lift import Lifted, conclude_lift, lift_row, shake_course
from lgrasp.simulate.model import Model
from lgrasp.simulate.mujoco_world import MujocoWorld
from lgrasp.simulate.slip import Frames, points_on_links, slips
from lgrasp.simulate.verdict import (
    AXES,
    Bounds,
    Closed,
    Look,
    Pulls,
    Verdict,
    at_rest,
    chunk_of,
    conclude,
    moved,
    worst,
)
from lgrasp.simulate.world import World


class Trial:
    """A simulation that serves one grasp after another; every thread has its own.

    Args:
        all_directions: continue after a direction in which the grasp is lost.
    """

    def __init__(self, model: Model, *, all_directions: bool = False) -> None:
        self._compiled, self._protocol = model, model.protocol
        self._model = model = model.own() if self._protocol.draws else model
        self._near, self._still = MujocoWorld(model, near=True), MujocoWorld(model)
        self._world: World = self._still if self._protocol.engine == "mujoco" else make_world(model)
        self._all = all_directions
        self._chunk = model.steps(chunk_of(self._protocol))
        self._bounds = Bounds(model.protocol)

    def run(self, rows: GraspRows, i: int) -> Verdict:
        """Judge row ``i``; if its protocol has draws, in all of them."""
        pose, at_q = rows.object_pose[i], self._look_at_q(rows, i)
        draws, found = self._protocol.draws, []
        if self._protocol.lift:
            return self._lift(rows, i, self._look(rows, i, pose, at_q))
        if draws is None:
            return self._judge(rows, i, pose, self._look(rows, i, pose, at_q))
        for number in range(draws.count):
            draw = draw_of(draws, int(rows.candidate[i]), number, len(pose))
            tune(self._model, self._compiled, draw)
            start = draw.placed(pose)
            found.append(self._judge(rows, i, start, self._look(rows, i, start, at_q)))
        return worst(found)

    def _look(self, rows: GraspRows, i: int, pose: np.ndarray, at_q: tuple[np.ndarray, np.ndarray]) -> Look:
        """Row ``i`` before it is simulated, hand where the protocol starts; the geometry is MuJoCo's."""
        still = self._still
        still.begin(self._protocol.stops(rows)[0][i], pose)
        return Look(*at_q, still.deepest(of_links=True), still.deepest(), still.data.qpos.copy())

    def _judge(self, rows: GraspRows, i: int, pose: np.ndarray, look: Look) -> Verdict:
        """Simulate row ``i`` with its objects at poses (O, 7)."""
        objects = len(self._model.object_body)
        closed = Closed(0, np.nan, False, np.full((objects, 2), np.nan), look.object_depth)
        pulls, diverged = Pulls.of(objects), False
        if look.depth <= self._protocol.most_penetration:
            if self._world is not self._still:
                self._world.begin(self._protocol.stops(rows)[0][i], pose)
            self._start = self._world.objects()
            closed = self._close(rows, i, look)
            diverged = self._world.wild()
            if diverged or self._bounds.lost(closed.moved):
                pulls.held[:], pulls.moved[:] = 0, closed.moved
            else:
                diverged = self._pull_all(closed, pulls)
        return conclude(self._bounds, look, closed, pulls, diverged)

    def _lift(self, rows: GraspRows, i: int, look: Look) -> Verdict:
        """Take the object of row ``i`` off its table."""
        fits = look.depth <= self._protocol.most_penetration
        found = lift_row(self._world, self._model, rows, i) if fits else Lifted()
        return conclude_lift(self._bounds, look, found)

    def _close(self, rows: GraspRows, i: int, look: Look) -> Closed:
        """From the start to the squeeze, each target approached evenly; ends early when all is lost."""
        stops = [self._model.controls(targets[i].astype(float)) for targets in self._protocol.stops(rows)]
        contacts, worst, depth = 0, np.zeros((len(self._model.object_body), 2)), look.object_depth
        ramp = steps = self._model.steps(self._protocol.phase)
        for a, b in pairwise(stops):
            if b is stops[-1]:  # the targets are q, the squeeze is next
                contacts = self._touching_at_rest()
                steps += round(self._protocol.rest / self._model.mujoco.opt.timestep)
            for step in range(steps):
                self._world.drive(a + (b - a) * min((step + 1) / ramp, 1.0))
                self._world.step(1)
                if (step + 1) % self._chunk == 0 or step + 1 == steps:
                    worst = np.maximum(worst, self._moved())
                    if self._world.wild():
                        return Closed(contacts, np.nan, False, np.full_like(worst, np.nan), depth)
                    depth = max(depth, self._world.deepest())
                    if self._bounds.lost(worst):
                        return Closed(contacts, np.nan, False, worst, depth)
        rest = bool(at_rest(self._world.velocities()))
        return Closed(contacts, self._slip(rows, i, look.points), rest, worst, depth)

    def _touching_at_rest(self) -> int:
        """Fewest links on any object, at rest at the targets; the trial then continues from the previous state."""
        before = self._world.state()
        self._world.step(self._model.steps(self._protocol.settle))
        touching = self._world.links_touching()
        self._world.restore(before)
        return int(touching.min())

    def _pull_all(self, closed: Closed, pulls: Pulls) -> bool:
        """Run directions into ``pulls`` until all is decided; True if one diverged."""
        diverged, holds, stays = False, True, True
        squeezed, shaken = self._world.state(), self._protocol.shake
        base = self._world.frames()[1][self._model.base_body].copy()
        hold = np.ones((self._model.steps(self._protocol.hold), 1))
        course = shake_course(self._protocol) if shaken else {k: hold * axis for k, axis in enumerate(AXES)}
        for k, load in course.items():
            if not shaken:
                self._world.restore(squeezed)
            diverged |= self._pull_into(pulls, k, load @ base.T, closed)
            holds, stays = holds and pulls.held[k] == 1, stays and self._bounds.stays(pulls.moved[k])
            if not (self._all or holds or stays):
                break
        return diverged

    def go_on(
        self, state: Sequence[np.ndarray], home: np.ndarray, load: np.ndarray, pulls: Pulls, k: int, so_far: Closed
    ) -> bool:
        """End direction k that another simulation began, into ``pulls``; True if it diverged.

        Args:
            state: of :meth:`MujocoWorld.take`.
            home: poses of the objects at the start, (O, 7).
            load: what is left of it, (T, 3).
        """
        self._still.take(*state)
        self._start = home
        return self._pull_into(pulls, k, load, so_far)

    def _pull_into(self, pulls: Pulls, k: int, load: np.ndarray, so_far: Closed) -> bool:
        """Run direction k into ``pulls``; True if it diverged."""
        pulls.moved[k], pulls.depth[k] = self._pull(load, so_far)
        if self._world.wild():
            pulls.held[k], pulls.moved[k] = 0, np.nan
            return True
        pulls.touches[k] = self._world.links_touching() > 0
        pulls.held[k] = self._bounds.held(pulls.moved[k], pulls.touches[k], pulls.depth[k])
        return False

    def _pull(self, load: np.ndarray, closed: Closed) -> tuple[np.ndarray, float]:
        """Load the objects in each of T steps, over their forces, (T, 3) [world frame]; ends early where they have come
        to rest well inside their bounds under an even load.

        Returns:
            How far each object moved at worst, (O, 2) [m], [rad], and the deepest penetration of any [m].
        """
        worst, depth = closed.moved, closed.depth
        may_stop = bool((load == load[0]).all())
        done, before, total = 0, self._moved(), len(load)
        while done < total:
            steps = min(self._chunk, total - done)
            self._go(load[done : done + steps])
            done += steps
            now = self._moved()
            worst = np.maximum(worst, now)
            if self._world.wild():
                break
            depth = max(depth, self._world.deepest())
            if self._bounds.lost(worst):
                break
            near = may_stop and self._bounds.near(before, now, (total - done) / steps)
            if near and self._bounds.held(worst, self._world.links_touching() > 0, depth):
                break
            before = now
        return worst, depth

    def _go(self, load: np.ndarray) -> None:
        """One step under each load (n, 3)."""
        for some in [load] if (load == load[0]).all() else load[:, None]:
            self._world.push(self._model.forces[:, None] * some[0])
            self._world.step(len(some))

    def _look_at_q(self, rows: GraspRows, i: int) -> tuple[np.ndarray, np.ndarray]:
        """Contact points on their links at q, (O, C, 3) in body frames [m], and links within 1 mm of each object."""
        self._near.begin(rows.q[i], rows.object_pose[i])
        points = points_on_links(
            self._model, _one(self._near.frames()), rows.contact_links[i : i + 1], rows.contact_points[i : i + 1]
        )
        return points[0], self._near.links_touching()

    def _slip(self, rows: GraspRows, i: int, points: np.ndarray) -> float:
        """How far the points of links are from the contact points that they made at q [m], largest; NaN: none."""
        links, own = rows.contact_links[i : i + 1], rows.contact_points[i : i + 1]
        return float(slips(self._model, _one(self._world.frames()), links, points[None], own)[0])

    def _moved(self) -> np.ndarray:
        """How far each object is from its start: displacement [m] and rotation [rad], (O, 2)."""
        return moved(self._world.objects(), self._start)


def _one(frames: Frames) -> Frames:
    """The frames of one grasp, as those of n."""
    return frames[0][None], frames[1][None]

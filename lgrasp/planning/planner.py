"""Grasp planning: many starts before a surface, a parallel local search, the best of each start."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import numpy as np
import warp as wp

from lgrasp.errors import ObjectError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import Compared, ContactTable, check_grasps, compare_grasps
from lgrasp.grasp.find_contacts import find_contacts
from lgrasp.grasp.outcomes import NOT_HELD, REASONS, Outcome, bounds_squeeze, failed_bounds
from lgrasp.grasp.tables import GraspTable, join_rows, take_grasps, take_rows
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.contact_surface import ContactSurface, palm_axis
from lgrasp.hold.run import METRICS, ControlPoses, HoldTester
from lgrasp.object.arrays import ObjectArrays, upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.planning.params import Effort, PlanParams
from lgrasp.planning.starts import GOLDEN_ANGLE, start_poses, tilted
from lgrasp.refine.descent import Descent
from lgrasp.refine.hands import Hands
from lgrasp.refine.surface import farthest_points, hand_surface
from lgrasp.refine.volume import upload_target
from lgrasp.runtime.cores import cores
from lgrasp.runtime.device import KERNEL_OPTIONS

_CPU_STARTS = 10  # planned at a time
_GPU_HANDS = 1 << 16  # searched at a time
_COLLIDES = 1.0e-3  # [m]
_WHOLE_LOAD = 5.0e-3  # [m] early in a search so much penetration is as bad as to resist nothing
_COARSE_BOUNDS = {"max_penetration": 0.01, "max_gap": 0.012, "max_normal_angle": 60.0, "max_normal_spread": 90.0}

wp.set_module_options(KERNEL_OPTIONS)


def _loosened(bounds: GraspBounds) -> GraspBounds:
    """Conditions that hands must meet after the first outer steps, to separate them from those without any contact."""
    return bounds.changed(**{name: max(least, getattr(bounds, name)) for name, least in _COARSE_BOUNDS.items()})


class Guesses(NamedTuple):
    """Hands of n starts, k of each, one start after another."""

    pose: np.ndarray
    """T_hand_object of the object's internal frame, device poses (n k, 7)."""
    q: np.ndarray
    """Joints within their limits [rad or m], (n k, K)."""


class Planned(NamedTuple):
    """Plans of the starts."""

    grasps: GraspTable
    """The best of each start that passed all checks; ``index`` is the start. Metric ``valid`` tells those kept that did
    not."""
    counts: dict[str, int]
    """Starts, those whose open hand collides, and outcomes of the others."""


@dataclass(frozen=True)
class Planner:
    """Plans grasps of one object by one hand.

    Args:
        stand_off: distance of the hand's base from the surface at the start [m].
        palmar: where the hand may touch; default: where hand.yaml lets it.
        around: what else the hand must not touch, in the object's internal frame.
        guesses: hands to begin with in place of open ones before the surface, as many of each start as are drawn.
        others: what the object may be as well: hands are tried on it and these in turn.
    """

    hand: HandArrays
    model: ObjectModel
    stand_off: float
    params: PlanParams = field(default_factory=PlanParams)
    palmar: ContactSurface | None = None
    around: ObjectModel | None = None
    guesses: Guesses | None = None
    others: tuple[ObjectModel, ...] = ()

    def run(
        self, count: int, progress: Callable[[int, int], None] | None = None, *, keep_invalid: bool = False
    ) -> Planned:
        """Plans from ``count`` starts; those of a start do not depend on the others.

        Args:
            progress: called with (starts done, plans); what it raises ends the planning.
            keep_invalid: the best of a start is kept too where it fails a check.

        Raises:
            HandError: no side of the hand can face an object.
        """
        device = self.hand.device
        points = np.arange(count)
        if self.guesses is None:
            points = farthest_points(self.model.contact_points.astype(float), count)
        each = self.params.rolls if self.guesses is None else self.effort.draws
        size, workers = (_CPU_STARTS, cores()) if device == "cpu" else (_GPU_HANDS // each, 1)
        counts: dict[str, int] = dict.fromkeys(["starts", "colliding", *REASONS, NOT_HELD], 0)
        tables = []
        search = self._scene.search

        def plan(first: int) -> tuple[int, GraspTable, np.ndarray]:
            some = points[first : first + size]
            return len(some), *self._plan(search, some, first)

        with ThreadPoolExecutor(workers) as pool:
            for tried, table, outcome in pool.map(plan, range(0, count, size)):
                counts["starts"] += tried
                counts["colliding"] += tried - len(outcome)
                for code, name in enumerate(REASONS):
                    counts[name] += int((outcome == code).sum())
                counts[NOT_HELD] += int((outcome == Outcome.HOLD).sum())
                passed = outcome == Outcome.KEPT
                table.metrics["valid"] = passed.astype(np.float32)
                if keep_invalid:
                    links = self.hand.model.tree.link_groups
                    table.metrics["failed_bound"] = failed_bounds(table, outcome, self.effort.bounds, links)
                tables.append(take_grasps(table, np.flatnonzero(passed | keep_invalid)))
                if progress:
                    progress(counts["starts"], counts["kept"])
        return Planned(join_rows(tables), counts)

    @cached_property
    def effort(self) -> Effort:
        """What the parameters leave to the kind of hands."""
        return self.params.effort(None if self.guesses is None else self.hand.model.groups, bool(self.others))

    @cached_property
    def _scene(self) -> "_Scene":
        device, p = self.hand.device, self.params
        surface = hand_surface(self.hand.model, self.palmar, distal=p.distal, other=p.other)
        around = None if self.around is None else upload_object(self.around, device)
        target = upload_target(self.model, self.around, device)
        obj, search = upload_object(self.model, device), Descent(self.hand, target, self.effort.search, surface)
        others = [upload_object(other, device) for other in self.others]
        try:
            tester = HoldTester(self.hand, obj, self.effort.hold, others)
        except ObjectError:
            tester = None
        return _Scene(search, obj, around, tester)

    def _plan(self, search: Descent, points: np.ndarray, first: int) -> tuple[GraspTable, np.ndarray]:
        """The best hand of each start that does not collide, and its outcome."""
        p, bounds, rounds = self.params, self.effort.bounds, self.effort.search.matching_rounds
        start, at = self._opened(search, points, first) if self.guesses is None else self._guessed(points)
        if len(start):
            search.run(at, rounds=min(p.opening, rounds), whole=rounds)
            start, at = self._finalists(start, at)
            search.run(at, first=p.opening, rounds=rounds, whole=rounds)
            return self._steadiest(start, at)
        return check_grasps(*self._posed(at, bounds), bounds, index=start)

    def _opened(self, search: Descent, points: np.ndarray, first: int) -> tuple[np.ndarray, Hands]:
        """Starts, and open hands that advanced to the surface."""
        hand, clearance = self.hand.model, self.params.clearance
        start, pose, q, facing = self._starts(points, first)
        free = search.max_penetration(self._put(pose, q)) <= _COLLIDES
        start, at = start[free], self._put(pose[free], q[free])
        if len(start):
            centre, axis = palm_axis(hand)
            travel = np.full(len(start), max(self.stand_off - float(centre @ axis) - clearance, 0.0))
            search.advanced(at, facing[free], travel, clearance)
        return start, at

    def _guessed(self, starts: np.ndarray) -> tuple[np.ndarray, Hands]:
        """Starts, and the hands that were guessed for them."""
        assert self.guesses is not None
        each = self.effort.draws
        rows = (starts[:, None] * each + np.arange(each)).reshape(-1)
        return starts.repeat(each), self._inverse(self._put(self.guesses.pose[rows], self.guesses.q[rows]))

    def _finalists(self, start: np.ndarray, at: Hands) -> tuple[np.ndarray, Hands]:
        """The best hands of each start after the first matchings."""
        if np.bincount(start).max() <= self.effort.finalists:
            return start, at
        found = self._compared(at, _loosened(self.effort.bounds))
        place = _places(start, found.unresisted_load + found.penetration / _WHOLE_LOAD)
        rows = np.flatnonzero(place < self.effort.finalists)
        return start[rows], at.taken(rows)

    def _steadiest(self, start: np.ndarray, at: Hands) -> tuple[GraspTable, np.ndarray]:
        """One hand of each start, and its outcome: of those tried the one that holds most often, then the one that
        resists most; it is no plan if it holds too rarely."""
        bounds, tried = self.effort.bounds, self.effort.tried
        found = self._compared(at, bounds)
        passed = found.outcome == Outcome.KEPT
        place = _places(start, 2 * ~passed + found.unresisted_load)
        # what control poses show may fail any of them
        rows = np.flatnonzero((place < max(tried, 1)) | (passed if bounds_squeeze(bounds) else False))
        start, place, passed = start[rows], place[rows], passed[rows]
        table, outcome = check_grasps(
            *self._posed(at.taken(rows), bounds), bounds, around=self._scene.around, index=start
        )
        held, draws = self._held(table, np.where(passed, place, tried)), self.effort.hold.draws
        often = np.zeros(len(place))
        if held is not None:
            loose = ~bounds.held_by(held) if bounds.min_hold_probability > 0 else False
            outcome = np.where((outcome == Outcome.KEPT) & loose, Outcome.HOLD, outcome)
            often = held["hold_success"] + draws * held["hold_probability"]
        order = np.lexsort([place, -often, outcome != Outcome.KEPT, start])
        best = np.sort(order[np.flatnonzero(np.diff(start[order], prepend=-1))])
        return take_rows(table, best), outcome[best]

    def _compared(self, at: Hands, bounds: GraspBounds) -> Compared:
        bounds = bounds.changed(friction=self.params.rank_friction)
        return compare_grasps(*self._posed(at, bounds), bounds, around=self._scene.around)

    def _held(self, table: GraspTable, place: np.ndarray) -> dict[str, np.ndarray] | None:
        """Metrics of the hold test of each hand, (M,), 0 untried; None: none is tried.

        Of each start those at the first places are, until one always holds; twice as many at once each time, since few
        trials keep a GPU as long as many.
        """
        tester, tried, first = self._scene.tester, self.effort.tried, 0
        if tester is None or tried == 0:
            return None
        held = {name: np.zeros(len(place), np.float32) for name in METRICS}
        while first < tried:
            last = min(2 * first + 1, tried)
            always = (held["hold_success"] > 0) & (held["hold_probability"] == 1)
            done = np.isin(table.index, table.index[always])
            rows = np.flatnonzero((place >= first) & (place < last) & ~done)
            if not len(rows):
                break
            poses, least = ControlPoses.of(take_grasps(table, rows)), self.effort.bounds.min_hold_probability
            for name, values in tester.run(poses, 0, least=least).items():
                held[name][rows] = values
            first = last
        return held

    def _starts(self, points: np.ndarray, first: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Start of each hand (M,), the hands' bases (M, 7) and joints (M, K), and the directions they face (M, 3).

        Starts count from ``first``, ``points`` are theirs among the contact points.
        """
        model, settings, rolls = self.model, self.hand.model.tree.settings, self.params.rolls
        start = np.repeat(first + np.arange(len(points)), rolls)
        at, normals = (a[points].repeat(rolls, 0).astype(float) for a in (model.contact_points, model.contact_normals))
        number = start * rolls + np.tile(np.arange(rolls), len(points))
        turn = (start * GOLDEN_ANGLE + 2 * np.pi * number / rolls) % (2 * np.pi)
        tilt = np.deg2rad(np.array(self.params.tilts))[number // len(settings) % len(self.params.tilts)]
        back = tilted(normals, tilt, number * GOLDEN_ANGLE)
        pose = start_poses(self.hand.model, at, back, turn, self.stand_off)
        # shared joints take their values in turn
        return start, pose, settings[number % len(settings)], -back

    def _put(self, pose: np.ndarray, q: np.ndarray) -> Hands:
        return Hands.put(pose, q, self.hand.device)

    def _inverse(self, at: Hands) -> Hands:
        """The same with the other pose: of the hand before the object, or of the object before the hand."""
        back = wp.empty_like(at.pose)
        wp.launch(invert_poses, len(back), [at.pose], [back], device=self.hand.device)
        return Hands(back, at.q)

    def _posed(
        self, at: Hands, bounds: GraspBounds
    ) -> tuple[HandArrays, ObjectArrays, wp.array, wp.array, ContactTable]:
        """What a check takes of hands."""
        held, obj = self._inverse(at), self._scene.object
        contacts = find_contacts(self.hand, obj, held.pose, held.q, bounds, self.palmar)
        return self.hand, obj, held.pose, held.q, contacts


def _places(start: np.ndarray, key: np.ndarray) -> np.ndarray:
    """Place of each hand (M,) among those of its start, by a key from 0 on, the least first; those of 16 are alike."""
    order = np.argsort(16.0 * start + np.minimum(key, 15.9), kind="stable")  # many times as fast as by two keys
    place = np.empty(len(start), int)
    place[order] = np.arange(len(start)) - np.searchsorted(start[order], start[order])
    return place


@dataclass(frozen=True)
class _Scene:
    """What a planning uploads once."""

    search: Descent
    object: ObjectArrays
    around: ObjectArrays | None
    tester: HoldTester | None
    """None: nothing is known of the object but a plane, which has no mass."""


@wp.kernel
def invert_poses(pose: wp.array(dtype=wp.transform), pose_out: wp.array(dtype=wp.transform)):
    """``T^-1``; launched over poses.

    Args:
        pose: (N,).
        pose_out: (N,).
    """
    i = wp.tid()
    pose_out[i] = wp.transform_inverse(pose[i])

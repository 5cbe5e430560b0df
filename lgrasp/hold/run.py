"""The hold test of many grasps of one object on a device."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays
from lgrasp.hold.kernels import (
    DRAWN_NUMBERS,
    Course,
    Spread,
    TrialPulls,
    Trials,
    TriedGrasps,
    Workers,
    try_grasps,
)
from lgrasp.hold.params import HoldTest
from lgrasp.hold.scratch import MAX_HAND_DOFS, MAX_TOUCHES, Contact, empty_scratches
from lgrasp.math.lanes import LANES, lanes_of
from lgrasp.object.arrays import ObjectArrays
from lgrasp.object.mass import mass_properties
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.fetch import fetch
from lgrasp.runtime.structs import empty_struct, make_struct, upload_struct
from lgrasp.simulate.protocol import DIRECTIONS, PROTOCOLS

METRICS = ("hold_success", "hold_probability", "hold_drift")
"""Of the test."""

_CLOSING_STEPS, _PULL_STEPS = 10, 40
_DRIVE_INERTIA = 4.0e-4  # [kg m^2] of a finger's joint, its drive and what it moves
_CONTACT_STIFFNESS = 2.0e4  # [N/m] of the trial without draws
_WORKERS = 1 << 12  # on a GPU: more than it has place for at a time
_MOST_TRIALS = 1 << 16  # at a time; each takes 4 KB


@dataclass(frozen=True)
class ControlPoses:
    """Grasps to test."""

    pregrasp: np.ndarray
    """(N, K) [rad or m], joints in the order of the hand's model."""
    grasp: np.ndarray
    squeeze: np.ndarray
    pose: np.ndarray
    """T_hand_object of the object's internal frame, device poses (N, 7)."""
    number: np.ndarray
    """(N,) integers from which random numbers come."""

    @classmethod
    def of(cls, table: GraspTable) -> "ControlPoses":
        """Those of finished grasps; their numbers are those of their candidates."""
        return cls(table.q_pregrasp, table.q, table.q_squeeze, table.pose, table.index)

    def __len__(self) -> int:
        return len(self.pose)


class HoldTester:
    """Tests grasps of one hand and one object.

    Args:
        hand, obj: on one device.
        others: what the object may be as well: draws take it and these in turn; the first trial is of the object.
    """

    def __init__(
        self, hand: HandArrays, obj: ObjectArrays, test: HoldTest, others: Sequence[ObjectArrays] = ()
    ) -> None:
        self._hand, self._test, self._device = hand, test, hand.device
        self._objects = [(one, course_of(one.model, hand.device)) for one in (obj, *others)]

    def run(
        self,
        postures: ControlPoses,
        seed: int,
        *,
        least: float = 0.0,
    ) -> dict[str, np.ndarray]:
        """The metrics of some grasps, each (N,) float32.

        ``hold_success``: 1 if the object stays in the hand in the first trial; ``hold_probability``: share of the draws
        in which it does; ``hold_drift``: the farthest that its centre of mass gets in the first trial [m], infinite if
        it is lost.

        Args:
            seed: of the draws, which depend on it and the row's ``number`` alone.
            least: grasps that cannot reach this probability any more are not tried on: theirs counts the draws that
                were not tried as lost, and those lost in the first trial are not drawn at all.
        """
        n, draws = len(postures), self._test.draws
        grasps = upload_struct(TriedGrasps, self._device, vars(postures) | {"number": _fold(postures.number)})
        held, drift = self._try(grasps, np.arange(n), self._sown(_nominal(), seed), np.zeros(n, int))
        hits = np.zeros(n)
        active = np.flatnonzero(held) if least > 0.0 else np.arange(n)
        # a GPU is fast if it has much to do at once
        together = 1 if self._device == "cpu" else max(draws, 1)
        spread = self._sown(_spread(self._test), seed)
        for first in range(0, draws, together):
            rows = np.repeat(active, together)
            found = self._try(grasps, rows, spread, np.tile(np.arange(first, first + together), len(active)))[0]
            hits[active] += found.reshape(-1, together).sum(1)
            active = active[hits[active] + draws - first - together >= least * draws - 1e-6]
        probability = hits / draws if draws else held.astype(float)
        return {
            "hold_success": held.astype(np.float32),
            "hold_probability": probability.astype(np.float32),
            "hold_drift": np.where(held, drift, np.inf).astype(np.float32),
        }

    def _sown(self, spread: Any, seed: int) -> Any:
        """Ranges with a seed, and strata for all draws: of each number they have one in each of as many equal parts of
        its range (Latin hypercube)."""
        n = max(self._test.draws, 1)
        order = np.random.default_rng(n).permuted(np.tile(np.arange(n), (int(DRAWN_NUMBERS), 1)), axis=1)
        spread.seed = seed
        spread.strata = wp.array((order.T / n).astype(np.float32), dtype=wp.float32, device=self._device)
        return spread

    def _try(self, grasps: Any, rows: np.ndarray, spread: Any, draws: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Whether each of some rows, in a draw each, holds (T,), and its displacement at worst (T,) [m]."""
        held, drift = np.zeros(len(rows), bool), np.zeros(len(rows))
        for number, (obj, course) in enumerate(self._objects):
            of_it = np.flatnonzero(draws % len(self._objects) == number)
            for at in range(0, len(of_it), _MOST_TRIALS):
                some = of_it[at : at + _MOST_TRIALS]
                held[some], drift[some] = self._launch(obj, course, grasps, rows[some], spread, draws[some])
        return held, drift

    def _launch(
        self, obj: ObjectArrays, course: Any, grasps: Any, rows: np.ndarray, spread: Any, draws: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        n, ways, device = len(rows), len(DIRECTIONS), self._device
        given = {
            "row": wp.array(rows.astype(np.int32), dtype=wp.int32, device=device),
            "draw": wp.array(draws.astype(np.int32), dtype=wp.int32, device=device),
            "contacts": wp.empty((n, MAX_TOUCHES), dtype=Contact, device=device),
            "q": wp.empty((n, MAX_HAND_DOFS), dtype=wp.float32, device=device),
        }
        trials = empty_struct(Trials, device, n, **given)
        held = wp.zeros((n, ways), dtype=wp.int32, device=device)
        displacement = wp.zeros((n, ways), dtype=wp.float32, device=device)
        pulls = make_struct(TrialPulls, held=held, displacement=displacement)
        both = [self._hand.struct, obj.struct, course, spread, grasps]
        # on a GPU every worker pulls one way only
        lanes = lanes_of(device)
        each, most = (1, _WORKERS) if lanes > 1 else (ways, 1)
        runs = n * (ways // each)
        scratch = empty_scratches(min(runs, most), device)
        closing, pulling = (
            make_struct(Workers, scratch=scratch, queue=wp.zeros(1, dtype=wp.int32, device=device)) for _ in range(2)
        )
        how = {"device": device, "block_dim": LANES}
        wp.launch(try_grasps, (min(n, most), lanes), [*both, 0, closing, trials, pulls], **how)
        wp.launch(try_grasps, (min(runs, most), lanes), [*both, each, pulling, trials, pulls], **how)
        stayed, moved = fetch([held, displacement])
        return np.all(stayed, axis=1), np.max(moved, axis=1)


def course_of(model: ObjectModel, device: str) -> Any:
    """What all trials of an object go through, a Course."""
    fc = PROTOCOLS["fc"]
    course = upload_struct(
        Course,
        device,
        {
            "closing_steps": _CLOSING_STEPS,
            "closing_time": fc.phase / _CLOSING_STEPS,
            "pull_steps": _PULL_STEPS,
            "pull_time": fc.hold / _PULL_STEPS,
            "force": fc.force,
            "most_displacement": fc.most_displacement,
            "most_rotation": float(np.radians(fc.most_rotation)),
            "drive_inertia": _DRIVE_INERTIA,
            "com": model.com,
        },
    )
    body = mass_properties(model.vertices, model.faces)
    course.inertia = wp.mat33(*map(float, (body.inertia / body.volume).ravel()))
    return course


def _fold(number: np.ndarray) -> np.ndarray:
    """31 bits of whole numbers (N,)."""
    wide = np.asarray(number).astype(np.uint64)
    return ((wide ^ (wide >> np.uint64(31))) & np.uint64(0x7FFFFFFF)).astype(np.int32)


def _nominal() -> Any:
    """The numbers of protocol fc, without torsional friction."""
    fc = PROTOCOLS["fc"]
    return _ranges(
        friction=(fc.friction, fc.friction),
        torsion=(0.0, 0.0),
        mass=(fc.mass, fc.mass),
        stiffness=(fc.stiffness, fc.stiffness),
        damping_ratio=(fc.damping_ratio, fc.damping_ratio),
        contact_stiffness=(_CONTACT_STIFFNESS, _CONTACT_STIFFNESS),
    )


def _spread(test: HoldTest) -> Any:
    names = ("friction", "torsion", "mass", "stiffness", "damping_ratio", "contact_stiffness")
    made = _ranges(**{name: getattr(test, name) for name in names})
    made.shift, made.turn = test.shift, float(np.radians(test.turn))
    return made


def _ranges(**ends: tuple[float, float]) -> Any:
    spread = Spread()
    for name, pair in ends.items():
        setattr(spread, name, wp.vec2(*pair))
    return spread

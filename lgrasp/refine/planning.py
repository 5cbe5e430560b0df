"""Grasp planning: many starts before a surface, a parallel local search, the best of each start."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from lgrasp.differentiable.rotations import matrix_from_quaternion, quaternion_from_matrix
from lgrasp.grasp.tables import GraspTable, join_grasps, take_grasps
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.refine.check import OUTCOMES, check_grasps
from lgrasp.refine.params import GraspBounds, LocalSearch
from lgrasp.refine.refiner import Pose, Refiner
from lgrasp.refine.starts import GOLDEN_ANGLE, palm_axis, start_poses
from lgrasp.refine.surface import DISTAL, OTHER, Palmar, farthest_points, hand_surface
from lgrasp.refine.target import Target

__all__ = ["PlanParams", "Planned", "Planner", "cloud_params", "object_pose", "table_pose"]

_CPU_STARTS, _GPU_STARTS = 40, 800  # planned at a time
_COLLIDES, _CLOUD_DEPTH = 1.0e-3, 4.0e-3  # [m]
_PLAN_BOUNDS = GraspBounds(
    penetration=0.002, self_margin=0.0, gap=0.004, angle=45.0, fold=60.0, balance=10.0, squeeze_force=40.0
)
_COARSE = GraspBounds(penetration=0.01, self_margin=0.0, gap=0.012, angle=60.0, fold=90.0, balance=10.0)


class PlanParams(BaseModel):
    """How many hands are tried, how far they are moved, and what a plan must satisfy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rolls: int = Field(
        default=12, ge=1, le=64, description="Hands that begin at each start, turned about the palm's normal."
    )
    finalists: int = Field(default=4, ge=1, le=64, description="Of these go on after the first outer steps.")
    opening: int = Field(default=5, ge=1, le=100, description="Outer steps of all of them.")
    clearance: float = Field(
        default=0.004, ge=0, le=0.1, description="Distance at which the open hand stops before the object."
    )
    distal: float = Field(
        default=DISTAL, ge=0, le=100, description="Weight of palmar points on the last links of fingers."
    )
    other: float = Field(default=OTHER, ge=0, le=100, description="Weight of the other palmar points.")
    search: LocalSearch = Field(
        default=LocalSearch(shift=0.002, turn=0.02, bend=0.04, reach=0.15, reach_end=0.1, soft=0.01, force=0.3),
        description="The local search.",
    )
    bounds: GraspBounds = Field(default=_PLAN_BOUNDS, description="What a plan must satisfy.")

    def weights(self) -> dict[str, float]:
        """Arguments of :func:`hand_surface`."""
        return {"distal": self.distal, "other": self.other}


def cloud_params(params: PlanParams) -> PlanParams:
    """The parameters for an object that is a point cloud, whose points lie off its surface by their noise."""
    bounds = params.bounds.model_copy(update={"penetration": max(params.bounds.penetration, _CLOUD_DEPTH)})
    return params.model_copy(update={"bounds": bounds})


class Planned(NamedTuple):
    """Plans of the starts."""

    grasps: GraspTable
    """The best of each start that passed all checks; ``index`` is the start."""
    counts: dict[str, int]
    """Starts, those whose open hand collides, and outcomes of the others."""


@dataclass(frozen=True)
class Planner:
    """Plans grasps of one object by one hand.

    Args:
        stand_off: distance of the hand's base from the surface at the start [m].
        palmar: where the hand may touch; default: where hand.yaml lets it.
        around: what else the hand must not touch, in the object's internal frame.
    """

    hand: HandArrays
    model: ObjectModel
    stand_off: float
    params: PlanParams = field(default_factory=PlanParams)
    palmar: Palmar | None = None
    around: ObjectModel | None = None

    def run(self, count: int, progress: Callable[[int, int], None] | None = None) -> Planned:
        """Plans from ``count`` starts; those of a start do not depend on the others.

        Args:
            progress: called with (starts done, plans); what it raises ends the planning.

        Raises:
            HandError: the hand has no palm.
        """
        p, hand, device = self.params, self.hand.model, self.hand.device
        target = Target(self.model, self.around, device=device)
        search = Refiner(hand, target, p.search, surface=hand_surface(hand, self.palmar, **p.weights()), device=device)
        points = farthest_points(self.model.contact_points.astype(float), count)
        counts: dict[str, int] = dict.fromkeys(["starts", "colliding", *OUTCOMES], 0)
        tables = []
        some = _CPU_STARTS if device == "cpu" else _GPU_STARTS
        for first in range(0, count, some):
            table, outcome = self._plan(search, points[first : first + some], first)
            counts["starts"] += len(points[first : first + some])
            counts["colliding"] += len(points[first : first + some]) - len(outcome)
            for code, name in enumerate(OUTCOMES):
                counts[name] += int((outcome == code).sum())
            tables.append(take_grasps(table, np.flatnonzero(outcome == 0)))
            if progress:
                progress(counts["starts"], counts["kept"])
        return Planned(join_grasps(tables), counts)

    def _plan(self, search: Refiner, points: np.ndarray, first: int) -> tuple[GraspTable, np.ndarray]:
        """The best hand of each start that does not collide, and its outcome."""
        p, hand = self.params, self.hand.model
        start, pose, facing = self._starts(points, first)

        def put(a: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(a, dtype=torch.float32, device=self.hand.device)

        centre, axis = palm_axis(hand)
        travel = put(np.full(len(start), max(self.stand_off - float(centre @ axis) - p.clearance, 0.0)))
        at = Pose(*map(put, pose))
        free = ~search.inside(at, _COLLIDES).cpu().numpy()
        at, start = _rows(at, free), start[free]
        at = search.advanced(at, put(facing[free]), travel[: len(start)], p.clearance)
        if len(start):
            at = search(*at, outer=p.opening).pose
            table, outcome = self._checked(at, start, _COARSE)
            best = _best(start, table, outcome, p.finalists)
            at, start = _rows(at, best), start[best]
            at = search(*at, first=p.opening).pose
        table, outcome = self._checked(at, start, p.bounds)
        best = _best(start, table, outcome, 1)
        return take_grasps(table, best), outcome[best]

    def _starts(
        self, points: np.ndarray, first: int
    ) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Start of each hand (M,), the hands (R, t, q), and the directions they face (M, 3); starts count from
        ``first``, ``points`` are theirs among the contact points."""
        model, settings, rolls = self.model, self.hand.model.tree.settings, self.params.rolls
        start = np.repeat(first + np.arange(len(points)), rolls)
        at, normals = (a[points].repeat(rolls, 0).astype(float) for a in (model.contact_points, model.contact_normals))
        number = start * rolls + np.tile(np.arange(rolls), len(points))
        turn = (start * GOLDEN_ANGLE + 2 * np.pi * number / rolls) % (2 * np.pi)
        R, t = start_poses(self.hand.model, at, normals, turn, self.stand_off)
        # shared joints take their values in turn
        return start, (R, t, settings[number % len(settings)]), -normals

    def _checked(self, pose: Pose, start: np.ndarray, bounds: GraspBounds) -> tuple[GraspTable, np.ndarray]:
        around = None if self.around is None else upload_object(self.around, self.hand.device)
        obj = upload_object(self.model, self.hand.device)
        q = pose.q.cpu().numpy()
        return check_grasps(
            self.hand, obj, object_pose(pose), q, bounds, palmar=self.palmar, around=around, index=start
        )


def object_pose(pose: Pose) -> np.ndarray:
    """T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (N, 7), of hands in that frame."""
    R = pose.R.mT
    t = -(R @ pose.t[..., None])[..., 0]
    return torch.cat([t, quaternion_from_matrix(R)], 1).cpu().numpy()


def table_pose(table: GraspTable, device: str) -> Pose:
    """Hands of grasps in the object's internal frame: inverse of :func:`object_pose`."""
    pose = torch.as_tensor(table.pose, device=device)
    R = matrix_from_quaternion(pose[:, 3:]).mT
    return Pose(R, -(R @ pose[:, :3, None])[..., 0], torch.as_tensor(table.q, device=device))


def _rows(pose: Pose, rows: np.ndarray) -> Pose:
    at = torch.as_tensor(rows, device=pose.q.device)
    return Pose(*(x[at] for x in pose))


def _best(start: np.ndarray, table: GraspTable, outcome: np.ndarray, count: int) -> np.ndarray:
    """Rows of the ``count`` best of each start: those that pass first, then those that resist most; rising."""
    order = np.lexsort([np.arange(len(start)), table.metrics["disturbance"], outcome != 0, start])
    place = np.arange(len(start)) - np.searchsorted(start[order], start[order])
    return np.sort(order[place < count])

"""Grasp planning: many starts before a surface, a parallel local search, the best of each start."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field

from lgrasp.differentiable.rotations import quaternion_from_matrix
from lgrasp.grasp.tables import GraspTable, take_grasps
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import upload_object
from lgrasp.object.model import ObjectModel
from lgrasp.refine.check import OUTCOMES, check_grasps
from lgrasp.refine.params import Bounds, LocalSearch
from lgrasp.refine.refiner import Pose, Refiner
from lgrasp.refine.starts import GOLDEN_ANGLE, palm_axis, start_poses
from lgrasp.refine.surface import HandSurface, farthest_points
from lgrasp.refine.target import Target

__all__ = ["PlanParams", "Planned", "Planner", "object_pose"]

_PLAN_BOUNDS = Bounds(penetration=0.002, self_margin=0.0, gap=0.004, angle=45.0, balance=10.0, squeeze_force=20.0)
_COARSE = Bounds(penetration=0.01, self_margin=0.0, gap=0.012, angle=60.0, balance=10.0)


class PlanParams(BaseModel):
    """How many hands are tried, how far they are moved, and what a plan must satisfy."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    rolls: int = Field(8, ge=1, le=64, description="Hands that begin at each start, turned about the palm's normal.")
    finalists: int = Field(2, ge=1, le=64, description="Of these go on after the first outer steps.")
    opening: int = Field(5, ge=1, le=100, description="Outer steps of all of them.")
    clearance: float = Field(0.004, ge=0, le=0.1, description="Distance at which the open hand stops before the object.")
    search: LocalSearch = LocalSearch(shift=0.002, turn=0.02, bend=0.04, reach=0.15, reach_end=0.1, soft=0.01)
    bounds: Bounds = _PLAN_BOUNDS


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
        surface: weighted points of the hand; default: those of hand.yaml's contact surface.
        around: what else the hand must not touch, in the object's internal frame.
    """

    hand: HandArrays
    model: ObjectModel
    stand_off: float
    params: PlanParams = PlanParams()
    surface: HandSurface | None = None
    around: ObjectModel | None = None

    def run(self, count: int) -> Planned:
        """Plans from ``count`` starts.

        Raises:
            HandError: the hand has no palm.
        """
        p, hand = self.params, self.hand.model
        device = self.hand.device
        target = Target(self.model, self.around, device=device)
        search = Refiner(hand, target, p.search, surface=self.surface, device=device)
        start, pose, facing = self._starts(count)
        counts = {"starts": count}

        def put(a: np.ndarray) -> torch.Tensor:
            return torch.as_tensor(a, dtype=torch.float32, device=device)

        centre, axis = palm_axis(hand)
        travel = put(np.full(len(start), self.stand_off - float(centre @ axis) - p.clearance))
        at = search.advanced(Pose(*map(put, pose)), put(facing), travel, p.clearance)
        # an open hand that is in something already does not begin
        free = ~search.inside(at, 1e-3).cpu().numpy()
        counts["colliding"] = count - len(np.unique(start[free]))
        at, start = _rows(at, free), start[free]
        if len(start):
            at = search(*at, outer=p.opening).pose
            table, outcome = self._checked(at, start, _COARSE)
            best = _best(start, table, outcome, p.finalists)
            at, start = _rows(at, best), start[best]
            at = search(*at, first=p.opening).pose
        table, outcome = self._checked(at, start, p.bounds)
        best = _best(start, table, outcome, 1)
        table, outcome = take_grasps(table, best), outcome[best]
        counts |= {name: int((outcome == k).sum()) for k, name in enumerate(OUTCOMES)}
        return Planned(take_grasps(table, np.flatnonzero(outcome == 0)), counts)

    def _starts(self, count: int) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray, np.ndarray], np.ndarray]:
        """Start of each hand (M,), the hands (R, t, q), and the directions they face (M, 3)."""
        model, tree, rolls = self.model, self.hand.model.tree, self.params.rolls
        points, normals = model.contact_points.astype(float), model.contact_normals.astype(float)
        chosen = np.repeat(farthest_points(points, count), rolls)
        start = np.repeat(np.arange(count), rolls)
        turn = (start * GOLDEN_ANGLE + 2 * np.pi * (np.arange(len(start)) % rolls) / rolls) % (2 * np.pi)
        R, t = start_poses(self.hand.model, points[chosen], normals[chosen], turn, self.stand_off)
        # shared joints take their values in turn
        return start, (R, t, tree.settings[np.arange(len(start)) % len(tree.settings)]), -normals[chosen]

    def _checked(self, pose: Pose, start: np.ndarray, bounds: Bounds) -> tuple[GraspTable, np.ndarray]:
        around = None if self.around is None else upload_object(self.around, self.hand.device)
        obj = upload_object(self.model, self.hand.device)
        q = pose.q.cpu().numpy()
        return check_grasps(self.hand, obj, object_pose(pose), q, bounds, around=around, index=start)


def object_pose(pose: Pose) -> np.ndarray:
    """T_hand_object of the object's internal frame, x y z [m] qx qy qz qw, (N, 7), of hands in that frame."""
    R = pose.R.mT
    t = -(R @ pose.t[..., None])[..., 0]
    return torch.cat([t, quaternion_from_matrix(R)], 1).cpu().numpy()


def _rows(pose: Pose, rows: np.ndarray) -> Pose:
    at = torch.as_tensor(rows, device=pose.q.device)
    return Pose(*(x[at] for x in pose))


def _best(start: np.ndarray, table: GraspTable, outcome: np.ndarray, count: int) -> np.ndarray:
    """Rows of the ``count`` best of each start: those that pass first, then those that resist most; rising."""
    order = np.lexsort([np.arange(len(start)), table.metrics["disturbance"], outcome != 0, start])
    place = np.arange(len(start)) - np.searchsorted(start[order], start[order])
    return np.sort(order[place < count])

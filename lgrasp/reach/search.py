"""Joints of an arm that bring the hand to poses, and straight to them: damped least squares from many starts."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from pytorch_kinematics.ik import PseudoInverseIK
from pytorch_kinematics.transforms import Transform3d

from lgrasp.reach.arm import Arm
from lgrasp.reach.self_collision import ArmSolids
from lgrasp.reach.targets import CODES, Targets
from lgrasp.runtime.ordered import in_order

POSITION, ROTATION = 1.0e-4, 1.0e-3
"""[m], [rad]: a pose that is missed by less is reached."""
STEP = 0.025
"""Length of the steps of the way [m]."""
MOST_TURN = 0.5
"""[rad or m] in a step: joints that move farther jump to another posture."""

_REACHED, _POSE, _WAY, _TABLE, _ITSELF = range(len(CODES))
_TOGETHER = 4  # starts of a round; rows that are reached take part in no other
_ROUGH, _WITHIN, _NEXT = 15, 10, 6  # iterations without limits, within them, and from one step of the way to the next
_ROWS = 256  # at a time


class Reached(NamedTuple):
    """What was found; NaN where the code is not 0."""

    code: np.ndarray
    """In CODES, of the start that came farthest, shape [N], int8."""
    q: np.ndarray
    """Joints at the pose [rad or m], shape [N, J], float32."""
    q_approach: np.ndarray
    """Joints where the way begins, shape [N, J], float32."""
    manipulability: np.ndarray
    """Root of det J J^T of the Jacobian [m, rad] at the pose, shape [N], float32."""


class ArmSearch:
    """Searches joints of an arm.

    Args:
        solids: of the arm, with the hand's base.
        tries: starts of each pose, well spread within the limits.
    """

    def __init__(self, arm: Arm, solids: ArmSolids, tries: int) -> None:
        self._arm, self._solids, self._chain = arm, solids, arm.chain()
        low, high = self._chain.low, self._chain.high
        drawn = torch.quasirandom.SobolEngine(len(arm.moving), scramble=True, seed=0).draw(tries).to(low)
        self._starts = low + drawn * (high - low)
        self._slides = torch.tensor([joint.prismatic for joint in arm.moving])
        self._points = [(self._chain.frame_to_idx[link], self._put(points)) for link, points in arm.points.items()]

    def __call__(
        self, targets: Targets, workers: int = 1, progress: Callable[[int, int], None] = lambda done, reached: None
    ) -> Reached:
        """Joints for targets; ``progress`` is called with targets done and reached."""
        threads = torch.get_num_threads()

        def work(first: int) -> Reached:
            torch.set_num_threads(1)  # on small arrays several wait for each other
            way = None if targets.way is None else targets.way[first : first + _ROWS]
            return self._block(Targets(targets.T[first : first + _ROWS], way, targets.table))

        parts, done, reached = [], 0, 0
        try:
            for _, part in in_order(work, range(0, len(targets.T), _ROWS), workers, ahead=1):
                parts.append(part)
                done, reached = done + len(part.code), reached + int((part.code == 0).sum())
                progress(done, reached)
        finally:
            torch.set_num_threads(threads)
        return Reached(*map(np.concatenate, zip(*parts, strict=True))) if parts else self._block(targets)

    def _block(self, targets: Targets) -> Reached:
        rows, joints = len(targets.T), len(self._arm.moving)
        code = np.full(rows, _POSE, np.int8)
        q, q_approach = (np.full((rows, joints), np.nan, np.float32) for _ in range(2))
        manipulability = np.full(rows, np.nan, np.float32)
        near = self._within_span(targets)
        for starts in self._starts.split(_TOGETHER):
            left = np.flatnonzero(near & (code != _REACHED))
            if not len(left):
                break
            way = None if targets.way is None else targets.way[left]
            row, *found = self._round(Targets(targets.T[left], way, targets.table), starts)
            row, why, measure = left[row], found[0], found[1]
            np.maximum.at(code, row, why)
            order = np.lexsort((measure, row))
            best = order[np.append(row[order][1:] != row[order][:-1], True)[: len(order)]]  # of each row
            best = best[measure[best] >= 0]
            code[row[best]] = _REACHED
            manipulability[row[best]], q[row[best]], q_approach[row[best]] = (x[best] for x in found[1:])
        return Reached(code, q, q_approach, manipulability)

    def _within_span(self, targets: Targets) -> np.ndarray:
        """Targets (N,) whose pose and beginning of the way are no farther than the arm is long, bool."""
        center, length = self._arm.span
        away = targets.T[:, :3, 3] - center
        begin = away if targets.way is None else away - targets.way
        return np.maximum(np.linalg.norm(away, axis=1), np.linalg.norm(begin, axis=1)) <= length

    def _round(self, targets: Targets, starts: torch.Tensor) -> list[np.ndarray]:
        """What each start that comes to a pose is worth: its target, its code, manipulability (-1: not reached), joints
        at the pose and where the way begins."""
        T = self._put(targets.T)
        ik = self._ik(starts, _ROUGH, enforce_joint_limits=True, num_limit_refinement_iterations=_WITHIN)
        ik.initial_config = self._near(starts, T)
        found = ik.solve(Transform3d(matrix=T))
        row, start = torch.nonzero(found.converged, as_tuple=True)
        q = at = found.solutions[row, start]
        good, height = torch.ones_like(row, dtype=torch.bool), self._height(q, targets.table)
        passed = [q]
        if targets.way is not None and len(row):
            way = self._put(targets.way)[row]
            steps = round(float(np.linalg.norm(targets.way[0])) / STEP)
            for step in range(1, steps + 1):
                moved = T[row]
                moved[:, :3, 3] -= step / steps * way
                before, (at, there) = at, self._follow(at, moved)
                good &= there & ((at - before).abs() <= MOST_TURN).all(1)
                height = torch.minimum(height, self._height(at, targets.table))
                passed.append(at)
        code = torch.where(good, torch.where(height < 0, _TABLE, _REACHED), _WAY)
        for at in passed:
            left = code == _REACHED
            code[left] = torch.where(self._clear(at[left]), _REACHED, _ITSELF)
        J = self._chain.jacobian_tensor(q)
        measure = torch.linalg.det(J @ J.mT).clamp_min(0.0).sqrt()
        return [x.cpu().numpy() for x in (row, code, torch.where(code == _REACHED, measure, -1.0), q, at)]

    def _near(self, starts: torch.Tensor, T: torch.Tensor) -> torch.Tensor:
        """The starts (S, J) for each pose (n, 4, 4), with slides moved to bring the hand there (n, S, J): limits of
        slides may be far away."""
        J, at = self._chain.jacobian_tensor(starts, True)
        moves = torch.linalg.pinv(J[:, :3, self._slides], rtol=0.1)
        q = starts.repeat(len(T), 1, 1)
        q[..., self._slides] += ((T[:, None, :3, 3] - at[:, :3, 3])[:, :, None] @ moves.mT)[:, :, 0]
        return q.clamp(self._chain.low, self._chain.high)

    def _follow(self, q: torch.Tensor, T: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Joints (n, J) for poses (n, 4, 4) near those of q (n, J), and which came there (n,)."""
        ik = self._ik(q[:1], _NEXT, enforce_joint_limits=False, clamp_to_limits=True)
        ik.initial_config = q[:, None]  # a start of its own for each pose
        found = ik.solve(Transform3d(matrix=T))
        return found.solutions[:, 0], found.converged[:, 0]

    def _height(self, q: torch.Tensor, table: np.ndarray | None) -> torch.Tensor:
        """Of the lowest point of the links above the table [m] (n,)."""
        height = torch.full((len(q),), torch.inf, dtype=q.dtype)
        if table is None or not len(q):
            return height
        up, links = self._put(table), self._chain.forward_kinematics_tensor(q)
        for frame, points in self._points:
            R, t = links[frame, :, :3, :3], links[frame, :, :3, 3]
            low = ((up[:3] @ R) @ points.T).amin(1) + t @ up[:3] - up[3]
            height = torch.minimum(height, low)
        return height

    def _clear(self, q: torch.Tensor) -> torch.Tensor:
        """Which postures (n, J) are without self-collision (n,)."""
        return torch.as_tensor(self._solids.clear(q.double().cpu().numpy()))

    def _put(self, values: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(values, dtype=self._chain.dtype)

    def _ik(self, starts: torch.Tensor, iterations: int, **how: Any) -> PseudoInverseIK:
        return PseudoInverseIK(
            self._chain,
            pos_tolerance=POSITION,
            rot_tolerance=ROTATION,
            retry_configs=starts,
            max_iterations=iterations,
            regularlization=1.0e-6,
            early_stopping_no_improvement=None,
            **how,
        )

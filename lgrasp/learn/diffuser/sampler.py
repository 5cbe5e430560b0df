"""Steps drawn by a trained network for hands that hold objects already."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.geometry.rotations import motion_from_pose, pose_from_motion
from lgrasp.grasp.sequences import HeldHands
from lgrasp.hand.tree import Tree
from lgrasp.learn.diffuser.features import held_features, random_rotations, shape_features
from lgrasp.learn.diffuser.network import DiffuserNet, Situation, joints_of
from lgrasp.learn.diffuser.process import PROCESSES
from lgrasp.learn.diffuser.senses import HeldObjects, Senses
from lgrasp.object.sdf import SdfGrid

_TURNS = 64  # rotations in which the network sees an object
_ROWS = 8192  # at a time


class DrawnSteps(NamedTuple):
    """What was drawn, N of it."""

    pose: np.ndarray
    """T_hand_object of the next object's centred frame, device poses (N, 7) f32."""
    q: np.ndarray
    """Joints, those that may not move bit by bit as they are, (N, K) f32."""


class StepSampler:
    """A network with the objects of a sequence before it.

    Args:
        process: name of the noising process that it was trained with.
        clouds: of the objects in their order, centred, (n, 3) [m] each. grids: their distances.
    """

    def __init__(
        self,
        tree: Tree,
        net: DiffuserNet,
        process: str,
        clouds: Sequence[np.ndarray],
        grids: Sequence[SdfGrid],
        device: str | torch.device = "cpu",
    ) -> None:
        self._device = torch.device(device)
        self._net = net.to(self._device).eval()
        self._process = PROCESSES[process]
        self._clouds = self._put(np.stack(clouds))
        self._turns = random_rotations(_TURNS, torch.Generator().manual_seed(0)).to(self._device)
        self._senses = Senses(tree, self._net.senses, self._net.held_basis, grids, self._device)
        self._shapes: dict[int, torch.Tensor] = {}  # by object: (V, B)

    @torch.no_grad()
    def draw(
        self, hands: HeldHands, space: int, free: np.ndarray, *, each: int, seed: int, steps: int = 10
    ) -> DrawnSteps:
        """``each`` steps for each of H hands, those of one hand one after another: the object after those held.

        A function of its arguments; what is drawn for one hand does not depend on the others but by rounding.

        Args:
            space: opposition space. free: joints that the steps may move, (H, K) bool.
            steps: of the sampling.
        """
        rows, joints = hands.q.shape
        number = hands.pose.shape[1]
        draw = torch.Generator().manual_seed(seed)
        noise = torch.randn(rows * each, 9 + joints, generator=draw)
        turn = torch.randint(_TURNS, (rows * each,), generator=draw)
        start, held = self._put(hands.q), self._held(hands, number)
        situation = Situation(
            self._shape(number)[:1].expand(rows, -1),
            held_features(self._net.held_basis, self._clouds, *held),
            start,
            self._put(hands.used, torch.bool),
            self._put(free, torch.bool),
            torch.full((rows,), space, dtype=torch.int64, device=self._device),
        )
        parts = []
        for picked in torch.arange(rows * each).split(_ROWS):
            row, own = (picked // each).to(self._device), turn[picked].to(self._device)
            seen = situation.rows(row)._replace(shape=self._shape(number)[own])
            objects = torch.full_like(row, number), HeldObjects(*(x[row] for x in held))
            R, t, q = self._drawn(seen, noise[picked].to(self._device), self._turns[own], objects, steps)
            parts.append((pose_from_motion(R, t), joints_of(start[row], q, seen.free)))
        pose, q = (torch.cat(x).cpu().numpy() for x in zip(*parts, strict=True))
        return DrawnSteps(pose, q)

    def _drawn(
        self,
        seen: Situation,
        noise: torch.Tensor,
        turn: torch.Tensor,
        objects: tuple[torch.Tensor, HeldObjects],
        steps: int,
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """R, t and joints; objects are what is grasped and what is held, seen in turned frames."""
        net, moving = self._net, self._net.moving(seen.free)
        known = net.situation(seen)

        def velocity(x: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
            R, position, q = net.noisy_steps(x, self._process.coefficients(t)[0], seen)
            return net(x, t, known, self._senses(R @ turn, position, q, *objects)) * moving

        R, t, q = net.steps(self._process.sample(velocity, noise * moving, steps))
        return R @ turn, t, q

    def _held(self, hands: HeldHands, number: int) -> HeldObjects:
        objects = torch.arange(number, device=self._device).expand(len(hands.q), number)
        return HeldObjects(objects, *motion_from_pose(self._put(hands.pose)))

    def _shape(self, number: int) -> torch.Tensor:
        """What the network sees of an object in each rotation, (V, B)."""
        if number not in self._shapes:
            self._shapes[number] = shape_features(self._net.basis, self._clouds[number], self._turns)
        return self._shapes[number]

    def _put(self, values: np.ndarray, dtype: torch.dtype = torch.float32) -> torch.Tensor:
        return torch.tensor(values, dtype=dtype, device=self._device)

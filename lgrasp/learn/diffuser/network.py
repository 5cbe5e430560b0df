"""The network: a step of a sequence under noise, and what it depends on -> how the noise is taken out."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import nn

from lgrasp.geometry.rotations import matrix_from_sixd, sixd_from_matrix
from lgrasp.learn.diffuser.params import DiffuserParams

POSE = 9
"""Numbers of a pose: position, and rotation in 6D."""
_FREQUENCIES = 16
_LEAST_SHARE, _FARTHEST = 0.05, 3.0  # of data in a row that is felt; standard deviations


class Situation(NamedTuple):
    """What N steps depend on."""

    shape: torch.Tensor
    """Distances from the basis points to the object to grasp, (N, B)."""
    held: torch.Tensor
    """Nearness of the hand's basis points to what is held, (N, H)."""
    start: torch.Tensor
    """Joints before the step [rad or m], (N, K)."""
    used: torch.Tensor
    """Joints that hold something, (N, K) bool."""
    free: torch.Tensor
    """Joints that the step may move, (N, K) bool."""
    space: torch.Tensor
    """Opposition space, (N,) int64."""

    def rows(self, index: torch.Tensor | slice) -> "Situation":
        """Some of the steps, by index or mask."""
        return Situation(*(x[index] for x in self))


class DiffuserNet(nn.Module):
    """Residual blocks of a perceptron; time and situation scale and shift what is in them.

    Steps are rows (N, 9 + K): position of the object in the hand frame [m], its rotation in 6D, joints; here always
    standardised by the mean and spread of the training data. Entries of joints that do not move are 0.

    Args:
        lower, upper: joint limits [rad or m], (K,).
        basis: points around the object, (B, 3); held_basis: in the hand frame, (H, 3) [m].
        senses: points of the hand's surface (:func:`~lgrasp.learn.diffuser.senses.sense_points`), (P, 4).
    """

    lower: torch.Tensor
    upper: torch.Tensor
    basis: torch.Tensor
    held_basis: torch.Tensor
    senses: torch.Tensor
    mean: torch.Tensor
    spread: torch.Tensor

    def __init__(
        self,
        lower: torch.Tensor,
        upper: torch.Tensor,
        spaces: int,
        basis: torch.Tensor,
        held_basis: torch.Tensor,
        senses: torch.Tensor,
        params: DiffuserParams,
    ) -> None:
        super().__init__()
        joints, w = len(lower), params.width
        self.spaces = spaces
        buffers = {"lower": lower, "upper": upper, "basis": basis, "held_basis": held_basis, "senses": senses}
        buffers |= {"mean": torch.zeros(POSE + joints), "spread": torch.ones(POSE + joints)}
        for name, values in buffers.items():
            self.register_buffer(name, values)
        self.shape = _perceptron(len(basis), w, params.dropout)
        self.hand = _perceptron(len(held_basis) + 3 * joints + spaces, w, params.dropout)
        self.time = _perceptron(2 * _FREQUENCIES, w, 0.0)
        self.feel = _perceptron(2 * len(senses) + len(held_basis), w, params.dropout)
        self.into, self.out = nn.Linear(POSE + joints, w), nn.Linear(w, POSE + joints)
        self.blocks = nn.ModuleList(_Block(w, params.dropout) for _ in range(params.blocks))
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)

    def situation(self, s: Situation) -> torch.Tensor:
        """What the blocks need of situations, (N, width); the same at all times."""
        unit = (self.upper - self.lower).clamp_min(1e-6)
        start = (2 * (s.start - self.lower) / unit - 1) * s.used  # others are where they are in every hand
        space = nn.functional.one_hot(s.space, self.spaces)
        hand = torch.cat([s.held.to(start), start, s.used.to(start), s.free.to(start), space.to(start)], 1)
        return self.shape(s.shape.to(start)) + self.hand(hand)

    def forward(self, x: torch.Tensor, t: torch.Tensor, situation: torch.Tensor, felt: torch.Tensor) -> torch.Tensor:
        """dx/dt of steps (N, 9 + K) at times (N, 1), for what :meth:`situation` gives.

        Args:
            felt: what the hand feels in the noisy step (:class:`~lgrasp.learn.diffuser.senses.Senses`), (N, 2 P + H).
        """
        angle = t * torch.exp(torch.linspace(0, math.log(200), _FREQUENCIES, device=t.device))
        c = nn.functional.silu(situation + self.time(torch.cat([angle.sin(), angle.cos()], 1)))
        h = self.into(x) + self.feel(felt)
        for block in self.blocks:
            h = block(h, c)
        return self.out(h)

    def standardised(self, R: torch.Tensor, t: torch.Tensor, q: torch.Tensor) -> torch.Tensor:
        """Rows of poses R (N, 3, 3), t (N, 3) and joints (N, K)."""
        return (torch.cat([t, sixd_from_matrix(R), q], 1) - self.mean) / self.spread

    def steps(self, x: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """R, t and joints within their limits: the inverse of :meth:`standardised`."""
        x = x * self.spread + self.mean
        q = x[:, POSE:].maximum(self.lower).minimum(self.upper)
        return matrix_from_sixd(x[:, 3:POSE]), x[:, :3], q

    def noisy_steps(
        self, x: torch.Tensor, share: torch.Tensor, s: Situation
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """R, t and joints of rows of which a share (N, 1) is data: as if the noise had been added to whole data.

        Joints that do not move are as before the step.
        """
        R, t, q = self.steps((x / share.clamp_min(_LEAST_SHARE)).clamp(-_FARTHEST, _FARTHEST))
        return R, t, joints_of(s.start, q, s.free)

    def moving(self, free: torch.Tensor) -> torch.Tensor:
        """1 where noise is mixed in, else 0, (N, 9 + K): the pose, and joints (N, K) that the step may move."""
        return torch.cat([torch.ones(len(free), POSE, device=free.device), free.to(self.mean)], 1)


def _perceptron(inputs: int, width: int, dropout: float) -> nn.Sequential:
    return nn.Sequential(nn.Linear(inputs, width), nn.SiLU(), nn.Dropout(dropout), nn.Linear(width, width))


class _Block(nn.Module):
    def __init__(self, width: int, dropout: float) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width, elementwise_affine=False)
        self.change = nn.Linear(width, 2 * width)
        self.first, self.second = nn.Linear(width, width), nn.Linear(width, width)
        self.drop = nn.Dropout(dropout)

    def forward(self, h: torch.Tensor, c: torch.Tensor) -> torch.Tensor:
        scale, shift = self.change(c).chunk(2, 1)
        return h + self.second(self.drop(nn.functional.silu(self.first(self.norm(h) * (1 + scale) + shift))))


def joints_of(start: torch.Tensor, drawn: torch.Tensor, free: torch.Tensor) -> torch.Tensor:
    """Joints after a step, (N, K): those that it may move as drawn, the others bit by bit as before."""
    return torch.where(free, drawn, start)


def spread_of(values: torch.Tensor, there: Sequence[torch.Tensor] | torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and standard deviation of each column (N, D) over the rows where it is ``there`` (N, D); 0 and 1 of none."""
    weight = torch.as_tensor(there).to(values)
    count = weight.sum(0).clamp_min(1)
    mean = (values * weight).sum(0) / count
    spread = (((values - mean) ** 2 * weight).sum(0) / count).sqrt()
    return mean, torch.where(spread > 1e-4, spread, 1.0)

"""Noise mixed into data and taken out again: diffusion with a cosine schedule, and flow matching, as one formula."""

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import torch

_LATE = 1.5  # power of times that are evenly spread: more of them are near the data

_Four = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]
Coefficients = Callable[[torch.Tensor], _Four]
"""t in [0, 1] -> a, b and their derivatives, of the shape of t."""


class Process(NamedTuple):
    """x_t = a(t) x_0 + b(t) noise from data at t = 0 to noise at t = 1; networks learn dx_t/dt.

    At t = 1 nothing of the data is left: a(1) = 0, b(1) = 1. Samples start from noise alone, so a process that ends
    before that gives rare modes too often.
    """

    coefficients: Coefficients

    def mix(self, x: torch.Tensor, noise: torch.Tensor, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """x_t and dx_t/dt of data (N, D) with noise (N, D) at times (N, 1)."""
        a, b, da, db = self.coefficients(t)
        return a * x + b * noise, da * x + db * noise

    @staticmethod
    def times(u: torch.Tensor) -> torch.Tensor:
        """Times of evenly random numbers, spread as sampling needs them."""
        return u**_LATE

    def sample(self, velocity: Callable[[torch.Tensor, torch.Tensor], torch.Tensor], noise: torch.Tensor, steps: int):
        """Data from noise (N, D): ``steps`` deterministic steps (DDIM; of straight lines, Euler's).

        Args:
            velocity: dx/dt at x (N, D) and times (N, 1), as learnt.

        Steps become shorter towards the data, where what is left of the noise is geometry.
        """
        x, times = noise, torch.linspace(1, 0, steps + 1, dtype=noise.dtype, device=noise.device) ** _LATE
        for t, after in pairwise(times):
            u = velocity(x, t.expand(len(x), 1))
            a, b, da, db = self.coefficients(t)
            unit = a * db - da * b
            data, rest = (db * x - b * u) / unit, (a * u - da * x) / unit
            a, b, _, _ = self.coefficients(after)
            x = a * data + b * rest
        return x


def _cosine(t: torch.Tensor) -> _Four:
    """Variance-preserving; the share of data falls like a cosine. Derivatives by the angle."""
    angle = 0.5 * torch.pi * t
    return angle.cos(), angle.sin(), -angle.sin(), angle.cos()


def _straight(t: torch.Tensor) -> _Four:
    one = torch.ones_like(t)
    return 1 - t, t, -one, one


PROCESSES = {"cosine": Process(_cosine), "flow": Process(_straight)}
"""By the name of the parameter ``process``."""

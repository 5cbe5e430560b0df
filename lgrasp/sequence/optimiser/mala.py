"""The Metropolis-adjusted Langevin algorithm: chains that sample exp(-E / T) exactly at every step size."""

from collections.abc import Callable

import torch

from lgrasp.runtime.streams import normals
from lgrasp.sequence.optimiser.anneal import Chain

_NOISE_STREAM = 1 << 31
"""Added to steps: streams of noise beside those of :func:`run_chain`."""


class Langevin:
    """Proposals x' = x - S grad E + sqrt(2 S T) noise with diagonal S, and the exact ratio of their densities.

    Coordinates may be curved as long as the way back from ``moved(x, d)`` is -d, as it is with shifts and turns about
    an object's own axes.

    Args:
        evaluate: see :meth:`Proposals.evaluate`; the gradient is by motions (N, G).
        moved: coordinates (N, D) after motions (N, G).
        seed: (N,) int64.
        scale: S of a step: step size times preconditioner, broadcasts to (N, G); 0 keeps a coordinate fixed.
        temperature: T of a step.
    """

    def __init__(
        self,
        evaluate: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
        moved: Callable[[torch.Tensor, torch.Tensor], torch.Tensor],
        seed: torch.Tensor,
        scale: Callable[[torch.Tensor], torch.Tensor],
        temperature: Callable[[torch.Tensor], torch.Tensor | float],
    ) -> None:
        self.evaluate, self.temperature = evaluate, temperature
        self._moved, self._seed, self._scale = moved, seed, scale

    def propose(self, step: torch.Tensor, chain: Chain) -> tuple[torch.Tensor, torch.Tensor]:
        g, scale = chain.gradient, self._scale(step)
        noise = normals(self._seed, step + _NOISE_STREAM, g.shape[1]).to(g.dtype)
        motion = -scale * g + (2 * self.temperature(step) * scale).sqrt() * noise
        return self._moved(chain.x, motion), motion

    def log_ratio(self, step: torch.Tensor, chain: Chain, proposed: Chain) -> torch.Tensor:
        scale, d = self._scale(step), proposed.memory
        there, back = d + scale * chain.gradient, -d + scale * proposed.gradient
        free = scale > 0
        difference = torch.where(free, (there * there - back * back) / torch.where(free, scale, 1), 0)
        return difference.sum(1) / (4 * self.temperature(step))

"""Chains of proposals that are accepted or not, one per row, and the published optimiser as such a chain."""

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch

from lgrasp.differentiable.streams import uniforms
from lgrasp.stages.sequence.anneal_params import OptimiserParams

__all__ = ["Annealing", "Chain", "Proposals", "accepted", "run_chain", "step_length", "temperature"]

_DRAWS = 5  # uniform numbers of a row and step: acceptance, two switches, two contact points


class Chain(NamedTuple):
    """Where N chains are."""

    x: torch.Tensor  # (N, D) coordinates
    contact: torch.Tensor  # (N, 2) int64 contact point on each side
    terms: torch.Tensor  # (N, T) energies
    gradient: torch.Tensor  # (N, G) of the weighted sum of energies


class Proposals(Protocol):
    """How a chain goes on."""

    def evaluate(
        self, x: torch.Tensor, contact: torch.Tensor, weights: torch.Tensor, /
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Energies (N, T) and the gradient (N, G) of their weighted sum at x (N, D)."""
        ...

    def propose(self, step: int, chain: Chain) -> torch.Tensor:
        """Coordinates (N, D) to go to."""
        ...

    def log_ratio(self, step: int, chain: Chain, proposed: Chain) -> torch.Tensor | float:
        """Logarithm of the density of proposing the way back over that of proposing this way, (N,)."""
        ...

    def temperature(self, step: int, /) -> float:
        """Temperature of a step."""
        ...


def step_length(params: OptimiserParams, step: int) -> float:
    """Length of a step of each coordinate [m, rad or 1]."""
    return params.step * params.step_decay ** (step / params.step_period)


def temperature(params: OptimiserParams, step: int) -> float:
    """Temperature of a step."""
    return params.temperature * params.temperature_decay ** (step / params.temperature_period)


def accepted(log_ratio: torch.Tensor, u: torch.Tensor) -> torch.Tensor:
    """Metropolis rule: (N,) bool, true with probability min(1, exp(log_ratio)), for uniform numbers u (N,)."""
    return u.log() < log_ratio.to(u.dtype)


def run_chain(
    proposals: Proposals,
    x: torch.Tensor,
    counts: torch.Tensor,
    seed: torch.Tensor,
    weights: torch.Tensor,
    *,
    switch: float,
    progress: Callable[[int], None] | None = None,
) -> Chain:
    """Run N chains; every row depends on its own start, seed and energies alone.

    Args:
        x: (N, D) starts. counts: (N, 2) contact points of each side; one of each is drawn, and drawn anew with
            probability ``switch`` in each step. seed: (N,) int64.
        weights: (S, T) of the energies in each of S steps. Energies of the state are weighed anew in each step.
        progress: called with the number of the step that is done.
    """
    first = uniforms(seed, len(weights), 2)
    chain = Chain(x, (first * counts).to(torch.int64), *proposals.evaluate(x, (first * counts).long(), weights[0]))
    for k, w in enumerate(weights.unbind(0)):
        u = uniforms(seed, k, _DRAWS)
        contact = torch.where(u[:, 1:3] < switch, (u[:, 3:] * counts).to(torch.int64), chain.contact)
        x = proposals.propose(k, chain)
        proposed = Chain(x, contact, *proposals.evaluate(x, contact, w))
        fall = ((chain.terms - proposed.terms) * w).sum(1) / proposals.temperature(k)
        go = accepted(fall + proposals.log_ratio(k, chain, proposed), u[:, 0])[:, None]
        chain = Chain(*(torch.where(go, new, old) for new, old in zip(proposed, chain, strict=True)))
        if progress is not None:
            progress(k + 1)
    return chain


class Annealing:
    """The published optimiser: steps down the gradient, divided by the root of its running mean square.

    Means are per row and coordinate, so that rows do not depend on one another.

    Args:
        evaluate: see :meth:`Proposals.evaluate`; the gradient is by all coordinates.
        retract: brings coordinates (N, D) back to valid ones.
        free: (N, D) bool coordinates that may change.
    """

    def __init__(
        self,
        evaluate: Callable[[torch.Tensor, torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]],
        retract: Callable[[torch.Tensor], torch.Tensor],
        free: torch.Tensor,
        params: OptimiserParams,
    ) -> None:
        self.evaluate, self._retract, self._free, self._params = evaluate, retract, free, params
        self._square: torch.Tensor | None = None

    def propose(self, step: int, chain: Chain) -> torch.Tensor:
        p, g = self._params, chain.gradient
        old = torch.zeros_like(g) if self._square is None else self._square
        self._square = p.smoothing * old + (1 - p.smoothing) * g * g
        root = (self._square / (1 - p.smoothing ** (step + 1))).sqrt() + 1e-8
        return self._retract(torch.where(self._free, chain.x - step_length(p, step) * g / root, chain.x))

    def log_ratio(self, step: int, chain: Chain, proposed: Chain) -> float:
        return 0.0  # the published rule leaves it out

    def temperature(self, step: int) -> float:
        return temperature(self._params, step)

"""Chains of proposals that are accepted or not, one per row; the published optimiser and a sampler as such chains."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch

from lgrasp.runtime.streams import normals, uniforms
from lgrasp.sequence.optimiser.culling import Culling
from lgrasp.sequence.optimiser.params import OptimiserParams
from lgrasp.sequence.optimiser.replay import replayed

_NOISE_STREAM = 1 << 31
"""Added to steps: streams of noise beside those of :func:`run_chain`."""
_DRAWS_PER_STEP = 5  # uniform numbers of a row and step: acceptance, two switches, two contact points


Evaluate = Callable[[torch.Tensor, torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""Of coordinates (N, D), contact points and weights: energies (N, T) and the gradient (N, G) of their sum."""


class Chain(NamedTuple):
    """Where N chains are."""

    x: torch.Tensor  # (N, D) coordinates
    contact: torch.Tensor  # (N, 2) int64 contact point on each side
    terms: torch.Tensor  # (N, T) energies
    gradient: torch.Tensor  # (N, G) of the weighted sum of energies
    memory: torch.Tensor  # (N, G) what the last proposal left behind, accepted or not


class Proposals(Protocol):
    """The next state of a chain. Steps are tensors, so that one can be recorded and replayed: () int64."""

    @property
    def evaluate(self) -> Evaluate:
        """Energies and their gradient."""
        ...

    def propose(self, step: torch.Tensor, chain: Chain) -> tuple[torch.Tensor, torch.Tensor]:
        """Coordinates (N, D) to go to, and the memory (N, G) that this leaves."""
        ...

    def log_ratio(self, step: torch.Tensor, chain: Chain, proposed: Chain) -> torch.Tensor | float:
        """Logarithm of the density of proposing the way back over that of proposing this way, (N,)."""
        ...

    def temperature(self, step: torch.Tensor, /) -> torch.Tensor | float:
        """Temperature of a step, ()."""
        ...


def step_lengths(params: OptimiserParams, device: str | torch.device) -> torch.Tensor:
    """Length of each step of a coordinate [m, rad or 1], (S,) f64."""
    step = torch.arange(params.iterations, dtype=torch.float64, device=device)
    return params.step * params.step_decay ** (step / params.step_period)


def temperatures(params: OptimiserParams, device: str | torch.device) -> torch.Tensor:
    """Temperature of each step, (S,) f64."""
    step = torch.arange(params.iterations, dtype=torch.float64, device=device)
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
    culling: Culling | None = None,
) -> Chain:
    """Run N chains; every row depends on its own start, seed and energies alone.

    Args:
        x: (N, D) starts. counts: (N, 2) contact points of each side; one of each is drawn, and redrawn with
            probability ``switch`` in each step. seed: (N,) int64.
        weights: (S, T) of the energies in each of S steps. Energies of the state are reweighted in each step.
        culling: of the energies; with it steps on a GPU are recorded once and replayed.
    """

    def advance(step: torch.Tensor, chain: Chain) -> Chain:
        w = weights.index_select(0, step[None])[0]
        u = uniforms(seed, step, _DRAWS_PER_STEP)
        contact = torch.where(u[:, 1:3] < switch, (u[:, 3:] * counts).to(torch.int64), chain.contact)
        there, memory = proposals.propose(step, chain)
        terms, gradient = proposals.evaluate(there, contact, w)
        proposed = Chain(there, contact, terms, gradient, memory)
        fall = ((chain.terms - proposed.terms) * w).sum(1) / proposals.temperature(step)
        go = accepted(fall + proposals.log_ratio(step, chain, proposed), u[:, 0])[:, None]
        kept = Chain._make(torch.where(go, new, old) for new, old in zip(proposed, chain, strict=True))
        return kept._replace(memory=memory)

    contact = (uniforms(seed, len(weights), 2) * counts).to(torch.int64)
    terms, gradient = proposals.evaluate(x, contact, weights[0])
    chain = Chain(x, contact, terms, gradient, torch.zeros_like(gradient))
    if x.is_cuda and culling is not None:
        return Chain._make(replayed(lambda k, s: advance(k, Chain._make(s)), chain, len(weights), culling))
    for k in range(len(weights)):
        chain = advance(torch.tensor(k, device=x.device), chain)
    return chain


class Annealing:
    """The published optimiser: steps down the gradient, divided by the root of its running mean square.

    Means are per row and coordinate, so that rows do not depend on one another.

    Args:
        evaluate: the gradient is by all coordinates.
        retract: brings coordinates (N, D) back to valid ones.
        free: (N, D) bool coordinates that may change.
    """

    def __init__(
        self,
        evaluate: Evaluate,
        retract: Callable[[torch.Tensor], torch.Tensor],
        free: torch.Tensor,
        params: OptimiserParams,
    ) -> None:
        self.evaluate, self._retract, self._free = evaluate, retract, free
        self._memory = params.smoothing
        self._lengths, self._temperatures = step_lengths(params, free.device), temperatures(params, free.device)

    def propose(self, step: torch.Tensor, chain: Chain) -> tuple[torch.Tensor, torch.Tensor]:
        g, share = chain.gradient, self._memory
        square = share * chain.memory + (1 - share) * g * g
        root = (square / (1 - share ** (step + 1))).sqrt() + 1e-8
        there = chain.x - self._lengths.take(step) * g / root
        return self._retract(torch.where(self._free, there, chain.x)), square

    def log_ratio(self, step: torch.Tensor, chain: Chain, proposed: Chain) -> float:
        return 0.0  # the published rule leaves it out

    def temperature(self, step: torch.Tensor) -> torch.Tensor:
        return self._temperatures.take(step)


@dataclass(frozen=True)
class Langevin:
    """The Metropolis-adjusted Langevin algorithm, which samples exp(-E / T) exactly at every step size.

    Proposals x' = x - S grad E + sqrt(2 S T) noise with diagonal S, and the exact ratio of their densities. Coordinates
    may be curved as long as the way back from ``moved(x, d)`` is -d, as it is with shifts and turns about an object's
    own axes.

    Args:
        evaluate: the gradient is by motions (N, G).
        moved: coordinates (N, D) after motions (N, G).
        seed: (N,) int64.
        scale: S of a step: step size times preconditioner, broadcasts to (N, G); 0 keeps a coordinate fixed.
        temperature: T of a step.
    """

    evaluate: Evaluate
    moved: Callable[[torch.Tensor, torch.Tensor], torch.Tensor]
    seed: torch.Tensor
    scale: Callable[[torch.Tensor], torch.Tensor]
    temperature: Callable[[torch.Tensor], torch.Tensor | float]

    def propose(self, step: torch.Tensor, chain: Chain) -> tuple[torch.Tensor, torch.Tensor]:
        g, scale = chain.gradient, self.scale(step)
        noise = normals(self.seed, step + _NOISE_STREAM, g.shape[1]).to(g.dtype)
        motion = -scale * g + (2 * self.temperature(step) * scale).sqrt() * noise
        return self.moved(chain.x, motion), motion

    def log_ratio(self, step: torch.Tensor, chain: Chain, proposed: Chain) -> torch.Tensor:
        scale, d = self.scale(step), proposed.memory
        there, back = d + scale * chain.gradient, -d + scale * proposed.gradient
        free = scale > 0
        difference = torch.where(free, (there * there - back * back) / torch.where(free, scale, 1), 0)
        return difference.sum(1) / (4 * self.temperature(step))

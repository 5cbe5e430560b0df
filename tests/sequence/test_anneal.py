"""The published optimiser: law of acceptance, schedules, per-row statistics."""

from itertools import pairwise

import numpy as np
import pytest
import torch

from lgrasp.runtime.streams import uniforms
from lgrasp.sequence.optimiser.anneal import Annealing, Chain, accepted, run_chain
from lgrasp.sequence.optimiser.params import OptimiserParams

LEVELS = torch.tensor([0.0, 0.3, 0.8, 1.0, 2.5])


class Levels:
    """Chains whose energy is a level of their first contact point; notes what was proposed and taken."""

    def __init__(self, temperature: float) -> None:
        self.seen: list[tuple[torch.Tensor, torch.Tensor]] = []
        self._temperature = temperature

    def evaluate(self, x, contact, weights, /):
        return LEVELS[contact[:, :1]], torch.zeros(len(x), 1)

    def propose(self, step, chain: Chain) -> tuple[torch.Tensor, torch.Tensor]:
        return chain.x + 1, chain.memory

    def log_ratio(self, step, chain: Chain, proposed: Chain) -> float:
        self.seen.append((chain.contact[:, 0], proposed.contact[:, 0]))
        return 0.0

    def temperature(self, step) -> float:
        return self._temperature


@pytest.mark.parametrize("fall", [0.5, -0.7, -3.0])
def test_acceptance_follows_the_exponential_law(fall):
    """Within 1 % of min(1, exp((E_old - E_new) / T)), with the numbers that the rows of a run draw."""
    u = uniforms(torch.arange(1_000_000), 7, 5)[:, 0]
    share = accepted(torch.full_like(u, fall), u).double().mean().item()
    assert share == pytest.approx(min(1.0, np.exp(fall)), rel=0.01)


def test_chains_accept_by_the_law_and_settle_in_its_equilibrium():
    rows, steps, T = 20_000, 40, 0.7
    counts = torch.tensor([[len(LEVELS), 3]]).expand(rows, 2)
    levels = Levels(T)
    chain = run_chain(levels, torch.zeros(rows, 1), counts, torch.arange(rows), torch.ones(steps, 1), switch=1.0)
    boltzmann = torch.softmax(-LEVELS / T, 0)
    share = torch.bincount(chain.contact[:, 0], minlength=5) / rows
    torch.testing.assert_close(share, boltzmann, atol=0.01, rtol=0)
    # what each step did to those that were offered level b in level a
    after = [old for old, _ in levels.seen[1:]] + [chain.contact[:, 0]]
    old, new = (torch.cat([pair[k] for pair in levels.seen]) for k in (0, 1))
    taken = torch.cat(after) == new
    for a in range(5):
        for b in range(5):
            if a != b:
                offered = (old == a) & (new == b)
                law = min(1.0, np.exp((LEVELS[a] - LEVELS[b]).item() / T))
                assert taken[offered].double().mean().item() == pytest.approx(law, abs=0.01)


def test_contact_points_are_drawn_anew_with_their_probability():
    rows, steps = 4000, 50
    counts = torch.tensor([[5, 1000]]).expand(rows, 2)
    levels = Levels(1e9)  # takes all
    seconds = []
    levels.evaluate = lambda x, contact, weights: (seconds.append(contact[:, 1]), torch.zeros(len(x), 1), x)[1:]
    run_chain(levels, torch.zeros(rows, 1), counts, torch.arange(rows), torch.ones(steps, 1), switch=0.3)
    changed = torch.stack([a != b for a, b in pairwise(seconds)]).double().mean().item()
    assert changed == pytest.approx(0.3 * 0.999, rel=0.01)


def test_old_energy_is_weighed_with_the_new_weights():
    """First only energy 0 counts, then only energy 1: a chain at rest in the wrong place leaves it at once."""

    class TwoTerms(Levels):
        def evaluate(self, x, contact, weights, /):
            side = contact[:, 0].float()
            return torch.stack([side, 1 - side], 1), torch.zeros(len(x), 1)

    counts = torch.tensor([[2, 1]]).expand(500, 2)
    weights = torch.tensor([[1.0, 0.0]] * 20 + [[0.0, 1.0]] * 20)
    halves = [
        run_chain(TwoTerms(1e-6), torch.zeros(500, 1), counts, torch.arange(500), weights[:n], switch=1.0).contact[:, 0]
        for n in (20, 40)
    ]
    assert (halves[0] == 0).all()
    assert (halves[1] == 1).all()


def chain_at(x: torch.Tensor, gradient: torch.Tensor, memory: torch.Tensor | None = None) -> Chain:
    memory = torch.zeros_like(gradient) if memory is None else memory
    return Chain(x, torch.zeros(len(x), 2, dtype=torch.int64), torch.zeros(len(x), 6), gradient, memory)


def annealing(free: torch.Tensor) -> Annealing:
    return Annealing(lambda *_: (torch.zeros(0), torch.zeros(0)), lambda x: x, free, OptimiserParams())


def test_steps_are_as_long_as_the_schedule_and_leave_the_rest_alone():
    chain = annealing(torch.tensor([[True, True, True, False]]))
    x, g = torch.zeros(1, 4), torch.tensor([[1e3, -2e-3, 7.0, 5.0]])
    moved, memory = chain.propose(torch.tensor(0), chain_at(x, g))
    torch.testing.assert_close(moved, torch.tensor([[-0.005, 0.005, -0.005, 0.0]]), rtol=1e-4, atol=0)
    for k in range(1, 100):  # the gradient stays as it is, so its mean square does
        moved, memory = chain.propose(torch.tensor(k), chain_at(x, g, memory))
    torch.testing.assert_close(moved[0, 0].item(), -0.005 * 0.95 ** (99 / 50), rtol=1e-4, atol=0)
    assert chain.temperature(torch.tensor(0)).item() == 32
    assert chain.temperature(torch.tensor(60)).item() == pytest.approx(32 * 0.95**2)


def test_running_mean_square_is_that_of_the_row():
    """Gradients 3 then 4 with memory 0.98: the root of (0.98 * 0.02 * 9 + 0.02 * 16) / (1 - 0.98^2)."""
    chain = annealing(torch.ones(2, 1, dtype=torch.bool))
    _, memory = chain.propose(torch.tensor(0), chain_at(torch.zeros(2, 1), torch.tensor([[3.0], [100.0]])))
    last = chain_at(torch.zeros(2, 1), torch.tensor([[4.0], [100.0]]), memory)
    moved, _ = chain.propose(torch.tensor(1), last)
    root = np.sqrt((0.98 * 0.02 * 9 + 0.02 * 16) / (1 - 0.98**2))
    length = 0.005 * 0.95 ** (1 / 50)
    np.testing.assert_allclose(moved[:, 0], [-length * 4 / root, -length], rtol=1e-5)

"""The loop of trainings: one that is interrupted anywhere ends with the same bits."""

import io
from contextlib import suppress

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lgrasp.errors import ConfigError
from lgrasp.learn import loop
from lgrasp.learn.curve import LossCurve
from lgrasp.learn.loop import GradientStep, Training, falling_rate

STEPS = {"first": 7, "second": 12}


class StopError(Exception):
    """What the user's Ctrl-C becomes."""


def train(training: Training) -> tuple[torch.nn.Module, list[LossCurve]]:
    """Two phases of one network with dropout, batches from a generator, and a schedule of each kind."""
    draw, curves = torch.Generator().manual_seed(3), []
    with torch.random.fork_rng([]):
        torch.manual_seed(5)
        net = torch.nn.Sequential(
            torch.nn.Linear(4, 16), torch.nn.ReLU(), torch.nn.Dropout(0.3), torch.nn.Linear(16, 1)
        )
        for phase, steps in STEPS.items():
            optimiser = torch.optim.AdamW(net.parameters(), lr=0.01)
            cycle = torch.optim.lr_scheduler.OneCycleLR(optimiser, 0.01, total_steps=steps + 1)
            rate = cycle if phase == "first" else falling_rate(optimiser, steps, 2)
            curves.append(LossCurve(steps))

            def loss(_: int) -> tuple[torch.Tensor, torch.Tensor]:
                x = torch.randn(8, 4, generator=draw)
                found = ((net(x)[:, 0] - x.sum(1)) ** 2).mean()
                return found, 2 * found

            gradient_step, parts = GradientStep(optimiser, rate, clip=1.0), {"net": net, "random": draw}
            training.run(phase, steps, gradient_step, loss, parts=parts, every=3, curve=curves[-1])
    return net, curves


@given(stops=st.lists(st.integers(0, 18), max_size=4))
@settings(max_examples=15, deadline=None)
def test_interrupted_trainings_end_with_the_same_bits(stops):
    """Every run is stopped after one of its steps; then one runs to the end."""
    whole, curves = train(Training())
    kept: dict[str, bytes] = {}
    for stop in stops:
        looks = iter(range(stop))

        def stop_once(*_, looks=looks, **__):
            if next(looks, None) is None:
                raise StopError

        with suppress(StopError):
            train(Training(stop_once, kept, lambda phases, steps: kept.update(phases), stop_once))
    net, again = train(Training(None, kept))
    for a, b in zip(net.parameters(), whole.parameters(), strict=True):
        assert torch.equal(a, b)
    assert [c.points for c in again] == [c.points for c in curves]


def test_what_is_told(monkeypatch):
    """Steps of all phases, the mean since the last look, and what an earlier run did; each phase is kept at its end."""
    told, kept = [], []
    _, curves = train(Training(lambda *a, kept: told.append((*a, kept)), {}, lambda p, n: kept.append((dict(p), n))))
    assert [done for done, _, _ in told] == [3, 6, 7, 10, 13, 16, 19]
    assert [n for _, n in kept] == [7, 19]
    assert told[0][1] == f"loss {curves[0].points[0][1]:.3f}"
    assert {before for *_, before in told} == {0}
    told.clear()
    again = Training(lambda *a, kept: told.append((*a, kept)), kept[0][0])
    train(again)
    assert [(done, before) for done, _, before in told] == [(10, 7), (13, 7), (16, 7), (19, 7)]
    assert set(again.seconds) == set(STEPS)
    kept.clear()
    monkeypatch.setattr(loop, "_KEEP", 0.0)
    train(Training(keep=lambda p, n: kept.append(n)))
    assert kept == list(range(1, 20))


def test_a_state_of_other_parts_is_not_gone_on_with():
    """Such as another version kept."""
    kept: dict[str, bytes] = {}
    train(Training(None, None, lambda phases, steps: kept.update(phases)))
    for phase in kept:
        state = torch.load(io.BytesIO(kept[phase]), weights_only=True)
        state["parts"]["something"] = state["parts"].pop("gradient_step")
        packed = io.BytesIO()
        torch.save(state, packed)
        kept[phase] = packed.getvalue()
    net, _ = train(again := Training(None, kept))
    assert again.resumed == 0
    for a, b in zip(net.parameters(), train(Training())[0].parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_training_that_diverges_says_so():
    weight = torch.nn.Parameter(torch.ones(1))
    gradient_step = GradientStep(torch.optim.SGD([weight], lr=1.0))
    loss = lambda step: (weight.sum(), weight.sum() * (np.nan if step else 1))  # noqa: E731
    with pytest.raises(ConfigError, match="diverged: its loss is nan at step 2"):
        Training().run("x", 5, gradient_step, loss, parts={}, curve=LossCurve(5))

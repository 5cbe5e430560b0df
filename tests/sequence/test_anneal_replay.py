"""Recorded steps on a GPU: the same state as steps made one by one, also where room for entries ran out."""

import pytest
import torch

from lgrasp.sequence.optimiser.culling import Culling
from lgrasp.sequence.optimiser.replay import replayed

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU here")


@pytest.mark.parametrize("room", [64.0, 1.0])
def test_equals_steps_one_by_one(room):
    """Sums over as many entries as the step's number says: more than there is room for after a while."""
    device = torch.device("cuda:0")
    culling = Culling((room,), device)
    values = torch.arange(1, 101, device=device)

    def advance(step, state):
        total, drawn = state
        kept = culling.keep(0, values <= step % 50)
        chosen = values[kept.index]
        if kept.used is not None:
            chosen = torch.where(kept.used, chosen, 0)
        return [total + chosen.sum(), drawn * 0.99 + step]

    start = [torch.zeros(3, dtype=torch.int64, device=device), torch.zeros(3, device=device)]
    found = replayed(advance, start, 230, culling)
    state = start
    for k in range(230):
        state = advance(torch.tensor(k, device=device), state)
    assert all(torch.equal(a, b) for a, b in zip(found, state, strict=True))
    assert not start[0].any()

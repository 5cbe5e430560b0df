"""Culling: both modes keep the same entries, in order; too little room is told."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from lgrasp.sequence.optimiser.culling import Culling


@settings(deadline=None, max_examples=60)
@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(1, 50))
def test_keep_gives_the_true_places_in_order(mask, room):
    expected = np.flatnonzero(mask)
    culling = Culling((float(room),), "cpu")
    freely = culling.keep(0, torch.tensor(mask))
    assert freely.used is None
    assert freely.index.tolist() == expected.tolist()
    culling.fix(1)
    fixed = culling.keep(0, torch.tensor(mask))
    assert len(fixed.index) == room
    assert fixed.used.sum() == min(len(expected), room)
    assert fixed.index[fixed.used].tolist() == expected[:room].tolist()
    assert ((fixed.index >= 0) & (fixed.index < len(mask))).all()
    assert culling.lacking(1) == (len(expected) > room)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.integers(0, 4), min_size=1, max_size=12), st.integers(1, 60))
def test_repeat_gives_every_entry_as_often_as_counted(counts, room):
    entries = np.repeat(np.arange(len(counts)), counts)
    numbers = np.concatenate([np.arange(n) for n in counts])
    culling = Culling((float(room),), "cpu")
    kept, number = culling.repeat(0, torch.tensor(counts))
    assert kept.index.tolist() == entries.tolist()
    assert number.tolist() == numbers.tolist()
    culling.fix(1)
    kept, number = culling.repeat(0, torch.tensor(counts))
    assert len(kept.index) == len(number) == room
    assert kept.index[kept.used].tolist() == entries[:room].tolist()
    assert number[kept.used].tolist() == numbers[:room].tolist()
    assert culling.lacking(1) == (len(entries) > room)


def test_room_grows_to_what_was_needed_at_most():
    culling = Culling((2.0, 2.0), "cpu")
    culling.fix(5)  # ten entries
    culling.keep(0, torch.ones(40, dtype=torch.bool))
    culling.keep(0, torch.zeros(40, dtype=torch.bool))
    culling.keep(1, torch.ones(10, dtype=torch.bool))
    assert culling.lacking(5)
    assert len(culling.keep(0, torch.ones(90, dtype=torch.bool)).index) == 60  # 1.5 times 40
    assert len(culling.keep(1, torch.ones(90, dtype=torch.bool)).index) == 10
    assert culling.lacking(5)
    culling.free()
    assert len(culling.keep(0, torch.ones(90, dtype=torch.bool)).index) == 90


def test_masks_of_entries_leave_out_the_unused():
    culling = Culling((3.0,), "cpu")
    culling.fix(1)
    kept = culling.keep(0, torch.tensor([False, True]))
    assert kept.allowed(torch.tensor([True, True, True])).tolist() == [True, False, False]
    assert kept.allowed(torch.ones(3, 2, dtype=torch.bool)).sum(1).tolist() == [2, 0, 0]
    with pytest.raises(AssertionError):
        Culling((1.0,), "cpu").lacking(1)  # not fixed

"""Opposition spaces of the next step: only those that are left, in an order that looks ahead or does not."""

from dataclasses import replace

import numpy as np
import pytest

from lgrasp.grasp.sequences import empty_sequences
from lgrasp.hand.opposition.spaces import Space, longest
from lgrasp.sequence.policy import space_orders

JOINTS = 16
FINGERS = {"index": range(4), "middle": range(4, 8), "ring": range(8, 12), "thumb": range(12, 16)}


def space(name, *fingers):
    mask = np.zeros(JOINTS, bool)
    for finger in fingers:
        mask[list(FINGERS[finger])] = True
    return Space(name, mask, (0, -1))


SPACES = (
    space("index-palm", "index"),
    space("middle-palm", "middle"),
    space("ring-palm", "ring"),
    space("thumb-palm", "thumb"),
    space("index-middle", "index", "middle"),
    space("middle-ring", "middle", "ring"),
    space("thumb-index", "thumb", "index"),
)


def rows(number, *steps):
    """Sequences that used some spaces, one after another."""
    table = empty_sequences(number, JOINTS, 5)
    used, free = np.zeros(JOINTS, bool), []
    for s in steps:
        free.append(SPACES[s].joints & ~used)
        used |= SPACES[s].joints
    steps_ = np.tile(np.array(steps, np.int32), (number, 1))
    masks = np.tile(np.array(free, bool).reshape(len(steps), JOINTS), (number, 1, 1))
    return replace(table, space=steps_, free=masks)


def test_uniform_draws_one_of_those_left_evenly():
    order = space_orders(rows(7000), SPACES, "uniform", 1, 0)
    assert (order[:, 1:] == -1).all()
    counts = np.bincount(order[:, 0], minlength=7)
    assert (np.abs(counts - 1000) < 5 * np.sqrt(1000)).all()


def test_no_space_twice_and_none_without_a_joint():
    """After thumb-index, index-palm and thumb-palm have no joint left (the paper's example)."""
    order = space_orders(rows(500, 6), SPACES, "uniform", 0, 3)
    assert set(order[:, 0]) == {1, 2, 4, 5}


def test_consumed_rows_have_none():
    order = space_orders(rows(3, 4, 5, 3), SPACES, "lookahead", 0, 0)
    assert (order == -1).all()


def test_lookahead_leaves_enough():
    """Three more objects after the first: only spaces that take one finger do."""
    order = space_orders(rows(50), SPACES, "lookahead", 3, 0)
    assert {s for s in order.ravel() if s >= 0} == {0, 1, 2, 3}
    order = space_orders(rows(50), SPACES, "lookahead", 1, 0)
    assert {s for s in order.ravel() if s >= 0} == set(range(7))
    assert len({tuple(row) for row in order}) > 20


def test_lookahead_takes_what_leaves_most_when_nothing_leaves_enough():
    order = space_orders(rows(5, 4, 5), SPACES, "lookahead", 4, 0)
    used = SPACES[4].joints | SPACES[5].joints
    best = max(longest(SPACES, (4, 5, s), used | SPACES[s].joints) for s in (3, 6))
    for s in {s for s in order.ravel() if s >= 0}:
        assert longest(SPACES, (4, 5, s), used | SPACES[s].joints) == best


@pytest.mark.parametrize("policy", ["uniform", "lookahead"])
def test_a_row_does_not_depend_on_what_others_did(policy):
    """Every row has random numbers of its own place, whatever the other rows' state."""
    mixed = rows(4, 0)
    other = replace(mixed, space=np.array([[0], [0], [4], [4]], np.int32))
    a = space_orders(mixed, SPACES, policy, 0, 9)
    b = space_orders(other, SPACES, policy, 0, 9)
    np.testing.assert_array_equal(a[:2], b[:2])

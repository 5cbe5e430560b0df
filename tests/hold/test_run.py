"""Verdicts of rows among others, draws and seeds; what is independent of what."""

import numpy as np
import pytest
from support.holding import certain, press

from lgrasp.hold.params import HoldTest
from lgrasp.hold.run import ControlPoses, HoldTester

FORCES = np.linspace(0.5, 8.0, 12)
TORSION = (0.0, 0.001)  # points do not stop a box from turning about them [m]


@pytest.fixture(scope="module")
def tester(two_fingers, box) -> HoldTester:
    return HoldTester(two_fingers, box, HoldTest(draws=8, torsion=TORSION))


@pytest.fixture(scope="module")
def rows() -> ControlPoses:
    return press(FORCES.tolist())


@pytest.fixture(scope="module")
def found(tester, rows) -> dict[str, np.ndarray]:
    return tester.run(rows, 5)


def take(rows: ControlPoses, which: np.ndarray) -> ControlPoses:
    return ControlPoses(*(values[which] for values in vars(rows).values()))


def test_more_force_holds_more_often(found):
    assert set(found["hold_success"]) == {0, 1}
    assert found["hold_probability"][0] < 0.5 < found["hold_probability"][-1]
    assert (np.diff(found["hold_success"]) >= 0).all()
    assert set(found["hold_probability"] * 8) <= set(range(9))
    assert np.isinf(found["hold_drift"]).tolist() == (found["hold_success"] == 0).tolist()


def test_a_row_knows_nothing_of_the_others(tester, rows, found):
    order = np.random.default_rng(0).permutation(len(rows))[:7]
    some = tester.run(take(rows, order), 5)
    for name, values in found.items():
        np.testing.assert_array_equal(some[name], values[order], err_msg=name)


def test_draws_follow_the_seed(tester, rows, found):
    other = tester.run(rows, 6)
    np.testing.assert_array_equal(other["hold_success"], found["hold_success"])
    np.testing.assert_array_equal(other["hold_drift"], found["hold_drift"])
    assert (other["hold_probability"] != found["hold_probability"]).any()
    again = tester.run(rows, 5)
    np.testing.assert_array_equal(again["hold_probability"], found["hold_probability"])


def test_draws_follow_the_number_of_the_row(tester):
    same = press([1.5] * 12)
    assert len(set(tester.run(same, 5)["hold_probability"])) > 1
    alike = ControlPoses(same.pregrasp, same.grasp, same.squeeze, same.pose, np.full(12, 1 << 40))
    assert len(set(tester.run(alike, 5)["hold_probability"])) == 1


@pytest.mark.parametrize("least", [0.5, 1.0])
def test_rows_that_reach_the_least_are_as_without_it(tester, rows, found, least):
    """Others are not tried to the end: they stay below it."""
    some = tester.run(rows, 5, least=least)
    reach = (found["hold_probability"] >= least) & (found["hold_success"] > 0)
    assert 0 < reach.sum() < len(rows)
    np.testing.assert_array_equal(some["hold_probability"][reach], found["hold_probability"][reach])
    assert (some["hold_probability"][~reach] < least).all()
    np.testing.assert_array_equal(some["hold_drift"], found["hold_drift"])


def test_without_draws_probability_is_success(two_fingers, box, rows, found):
    only = HoldTester(two_fingers, box, HoldTest(draws=0)).run(rows, 5)
    np.testing.assert_array_equal(only["hold_probability"], found["hold_success"])
    np.testing.assert_array_equal(only["hold_drift"], found["hold_drift"])


def test_certain_draws_repeat_the_first_trial(two_fingers, box, rows, found):
    fixed = HoldTester(two_fingers, box, certain(0.6)).run(rows, 5)
    np.testing.assert_array_equal(fixed["hold_probability"], found["hold_success"])


def test_no_rows(tester, rows):
    none = tester.run(take(rows, np.zeros(0, int)), 5)
    assert all(values.shape == (0,) for values in none.values())


def test_a_hand_that_does_not_touch_loses_the_object(two_fingers, box):
    rows = press([2.0])
    open_hand = ControlPoses(rows.pregrasp, rows.pregrasp, rows.pregrasp, rows.pose, rows.number)
    found = HoldTester(two_fingers, box, HoldTest(draws=2)).run(open_hand, 0)
    assert found["hold_success"] == 0
    assert found["hold_probability"] == 0
    assert found["hold_drift"] == np.inf

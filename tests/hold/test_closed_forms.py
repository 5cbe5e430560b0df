"""Friction and compliance that the hold test must find: two points, three points, levers. The pull is 1 N."""

import numpy as np
import pytest
import trimesh
from support.hands import with_efforts
from support.holding import ARM, AXIS, CONTACT, HALF, RADIUS, STIFF, certain, press, solid

from lgrasp.hold.params import HoldTest
from lgrasp.hold.run import ControlPoses, HoldTester

AROUND = np.array([0.9, 0.97, 1.03, 1.1])
HOLDS = [0, 0, 1, 1]


def test_a_block_between_two_fingers_slips_at_mu_n(two_fingers, box):
    """Friction is 0.6: two contacts hold 2 * 0.6 N across the fingers."""
    found = HoldTester(two_fingers, box, HoldTest(draws=0)).run(press(AROUND / (2 * 0.6)), 0)
    assert found["hold_success"].tolist() == HOLDS
    assert found["hold_probability"].tolist() == HOLDS
    assert np.isinf(found["hold_drift"]).tolist() == [True, True, False, False]


def test_a_block_between_two_plates_slips_at_mu_n(two_plates, box):
    """Whatever less they press with: what a moving object presses on for a moment lets friction hold no more."""
    less, more = np.arange(0.5, 0.98, 0.02), np.arange(1.03, 1.3, 0.03)
    found = HoldTester(two_plates, box, HoldTest(draws=0)).run(press(np.concatenate([less, more]) / (2 * 0.6)), 0)
    assert found["hold_success"].tolist() == [0] * len(less) + [1] * len(more)


@pytest.mark.parametrize("force", [1.0, 5.0])
def test_a_block_slips_at_mu_n_for_any_friction(two_fingers, box, force):
    held = [
        HoldTester(two_fingers, box, certain(share / (2 * force))).run(press([force]), 0)["hold_probability"][0]
        for share in AROUND
    ]
    assert held == HOLDS


@pytest.mark.parametrize("effort", [1.5, 5.0])
def test_fingers_press_no_harder_than_their_effort(two_fingers, box, effort):
    """Targets ask for more of each finger than its effort limit [N], which decides, as N above."""
    weak = with_efforts(two_fingers, effort)
    held = [
        HoldTester(weak, box, certain(share / (2 * effort))).run(press([effort + 2.0]), 0)["hold_probability"][0]
        for share in AROUND
    ]
    assert held == HOLDS


def test_fingers_that_are_too_weak_give_way(two_fingers, box):
    """Along the fingers one of them must bear the whole pull, however large friction is."""
    for effort, holds in ((0.9, 0), (1.1, 1)):
        found = HoldTester(with_efforts(two_fingers, effort), box, certain(2.0)).run(press([effort]), 0)
        assert found["hold_probability"] == [holds]


@pytest.mark.parametrize("force", [2.0, 10.0])
def test_a_corner_stays_as_deep_as_it_is_pressed(two_known_fingers, box, force):
    """Where link and object overlap, distances of both tell how deep it is, for as long as the pull lasts."""
    held = [
        HoldTester(two_known_fingers, box, certain(share / (2 * force), torsion=0.002)).run(press([force]), 0)[
            "hold_probability"
        ][0]
        for share in (0.9, 0.97, 1.1, 1.2)
    ]
    assert held == HOLDS


def test_draws_take_what_the_object_may_be_in_turn(two_fingers, box):
    """A block too narrow for the fingers is not held."""
    test = certain(0.6).model_copy(update={"draws": 4})
    narrow = solid(trimesh.creation.box((HALF, 0.06, 0.06)))
    for others, share in (
        ([], 1.0),
        ([box], 1.0),
        ([narrow], 0.5),
        ([narrow, narrow], 0.5),
        ([box, box, narrow], 0.75),
    ):
        found = HoldTester(two_fingers, box, test, others).run(press([5.0]), 0)
        assert (found["hold_success"][0], found["hold_probability"][0]) == (1, share)


def test_a_block_gives_way_like_two_springs(two_fingers, box):
    """Along the fingers the joints' springs hold, one beside the other, each in line with its contact's."""
    found = HoldTester(two_fingers, box, HoldTest(draws=0)).run(press([2.0, 4.0]), 0)
    np.testing.assert_allclose(found["hold_drift"], (1 / STIFF + 1 / CONTACT) / 2, rtol=0.03)


@pytest.mark.parametrize("force", [1.0, 2.0])
def test_a_ball_in_three_fingers_slips_at_mu_n(three_fingers, ball, force):
    """Along the axis three contacts hold three times the friction of one."""
    held = [
        HoldTester(three_fingers, ball, certain(share / (3 * force))).run(press([force], AXIS - RADIUS, 3), 0)[
            "hold_probability"
        ][0]
        for share in AROUND
    ]
    assert held == HOLDS


def test_levers_give_way_by_force_and_arm(two_levers, box):
    """A lever of stiffness k [N m/rad] is a spring of k / arm^2 at its tip; the two share the pull."""
    q = np.zeros((2, 3))
    turns = np.outer(np.array([2.0, 4.0]) * (ARM / 5.0 + 1 / CONTACT / ARM), [0, 1, 1])
    rows = ControlPoses(q - [0, 0.05, 0.05], q, q + turns, np.tile([0, 0, 0, 0, 0, 0, 1], (2, 1)), np.arange(2))
    found = HoldTester(two_levers, box, HoldTest(draws=0)).run(rows, 0)
    np.testing.assert_allclose(found["hold_drift"], (ARM**2 / 5.0 + 1 / CONTACT) / 2, rtol=0.03)


def test_two_points_hold_no_torque_about_their_line_without_torsional_friction(two_fingers, box):
    """The pull is at the centre of mass, 5 mm beside the line: each contact must bear half of its torque."""
    rows = press([5.0], shift=(0, 0, 0.005))
    need = 0.005 / (2 * 5.0)  # [m]
    held = [
        HoldTester(two_fingers, box, certain(0.6, torsion=share * need)).run(rows, 0)["hold_probability"][0]
        for share in (0, *AROUND)
    ]
    assert held == [0, *HOLDS]

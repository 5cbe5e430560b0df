"""Curves of trainings: every loss counts once, and cards stay small."""

import numpy as np
import pytest

from lgrasp.learn.curve import POINTS, LossCurve


def test_points_are_of_whole_turns():
    curve = LossCurve(100, turn=7)
    for step in range(1, 101):
        curve(step, float(step % 7))
    assert [step for step, _ in curve.points] == [*range(7, 100, 7), 100]
    assert {value for _, value in curve.points[:-1]} == {3.0}


@pytest.mark.parametrize(("steps", "every"), [(7, 1), (1000, 1), (1050, 50), (1030, 50)])
def test_points_are_means_of_all_losses(steps, every):
    curve = LossCurve(steps)
    losses = {step: float(np.sin(step)) for step in range(1, steps + 1) if step % every == 0 or step == steps}
    for step, loss in losses.items():
        curve(step, loss)
    assert 1 <= len(curve.points) <= POINTS
    assert curve.points[-1][0] == steps
    before = 0
    for step, value in curve.points:
        assert value == pytest.approx(np.mean([x for s, x in losses.items() if before < s <= step]), rel=1e-5)
        before = step

"""Curves of trainings: every loss counts once, and cards stay small."""

import numpy as np
import pytest

from lgrasp.learn.curve import POINTS, LossCurve


@pytest.mark.parametrize(("steps", "every"), [(7, 1), (1000, 1), (1050, 50), (1030, 50)])
def test_points_are_means_of_all_losses(steps, every):
    told = []
    curve = LossCurve(steps, lambda step, loss: told.append((step, loss)))
    losses = {step: float(np.sin(step)) for step in range(1, steps + 1) if step % every == 0 or step == steps}
    for step, loss in losses.items():
        curve(step, loss)
    assert told == list(losses.items())
    assert 1 <= len(curve.points) <= POINTS
    assert curve.points[-1][0] == steps
    before = 0
    for step, value in curve.points:
        assert value == pytest.approx(np.mean([x for s, x in losses.items() if before < s <= step]), rel=1e-5)
        before = step

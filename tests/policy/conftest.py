"""Pose policies of the hand of the tests, whose answers are known."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lgrasp.policy.model import HIT_FEATURES, POINTS, WIDTH, PosePolicy, Weights, policy_bytes


@pytest.fixture
def policy(inputs, tmp_path: Path) -> Callable[..., Path]:
    """policy(x=slope): file of a policy whose log-odds are the slope times the x of the centre of mass [m], in both
    networks; keywords replace fields."""
    tree = inputs.hand.model.tree

    def policy(x: float = 0.0, **changes: Any) -> Path:
        groups = inputs.hand.model.groups
        parts = []
        for points in (POINTS, 0):
            rows = np.zeros((Weights.height(groups, points), WIDTH), np.float32)
            first = HIT_FEATURES + 1 + 2 * WIDTH * groups  # the centre of mass, in tens of metres
            rows[first, :2] = 1, -1
            second = first + 4 + groups + points + 1
            rows[second, 0] = rows[second + 1, 1] = 1
            rows[second + WIDTH + 1, :2] = x / 10, -x / 10
            parts.append(Weights(rows))
        given = {"hand": "allegro", "joints": tree.joint_names, "groups": groups, "reach": parts[0]}
        given |= {"contacts": parts[1], "points": np.zeros((POINTS, 3), np.float32)}
        path = tmp_path / f"policy{len(list(tmp_path.glob('*.npz')))}.npz"
        path.write_bytes(policy_bytes(PosePolicy(**given | changes)))
        return path

    return policy

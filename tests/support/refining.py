"""A refiner of the shared hand and object, and hands at valid grasps: fixtures of the tests of refine and planning."""

from collections.abc import Callable

import pytest
import torch

from lgrasp.engine.batch import run_stages
from lgrasp.refine.params import LocalSearch
from lgrasp.refine.refiner import Pose, Refiner, table_pose


@pytest.fixture(scope="session")
def filtered(swift, context):
    """Valid grasps of the shared hand and object."""
    return run_stages(swift, context, 0, 2000, "filter")


@pytest.fixture(scope="session")
def valid(filtered) -> Pose:
    """Their hands, in the object's internal frame."""
    return table_pose(filtered, "cpu")


@pytest.fixture(scope="session")
def make(inputs) -> Callable[..., Refiner]:
    """make(**parameters): a refiner; keyword dtype too."""

    def make(dtype: torch.dtype = torch.float32, **params) -> Refiner:
        return Refiner(inputs.hand.model, inputs.object.model, LocalSearch(**params), dtype=dtype)

    return make


@pytest.fixture(scope="session")
def coarse() -> Callable[..., Pose]:
    """coarse(pose): the poses with noise of 1.5 cm, 15 degrees and 0.15 rad."""
    from lgrasp.geometry.rotations import so3_exp

    def coarse(pose: Pose, seed: int = 0) -> Pose:
        g = torch.Generator().manual_seed(seed)
        n = len(pose.t)
        turn, shift = torch.randn(n, 3, generator=g) * 0.15, torch.randn(n, 3, generator=g) * 0.009
        return Pose(so3_exp(turn) @ pose.R, pose.t + shift, pose.q + torch.randn(pose.q.shape, generator=g) * 0.15)

    return coarse

"""Fixtures of the stages."""

import pytest
from support import jaws

from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.jobs.hands import for_hand
from lgrasp.stages.context import Context


@pytest.fixture(scope="session")
def power() -> Pipeline:
    """Of a hand that closes its fingers."""
    return for_hand(load_pipeline("power"), "barrett")


@pytest.fixture(scope="session")
def jaws_and_ball(tmp_path_factory: pytest.TempPathFactory, device: str) -> Context:
    """A gripper and a ball, whose grasps are known in closed form."""
    return jaws.jaws_and_ball(tmp_path_factory.mktemp("jaws"), device)

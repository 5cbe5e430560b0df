"""Fixtures of the stages."""

import pytest

from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.jobs.hands import for_hand


@pytest.fixture(scope="session")
def power() -> Pipeline:
    """Of a hand that closes its fingers."""
    return for_hand(load_pipeline("power"), "barrett")

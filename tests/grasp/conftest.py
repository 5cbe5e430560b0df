"""Warp starts before the first test."""

import pytest

from lgrasp.runtime.device import start


@pytest.fixture(scope="session", autouse=True)
def _warp() -> None:
    start()

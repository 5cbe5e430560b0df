"""Warp starts before the first test."""

import pytest

from lgrasp.device.runtime import start


@pytest.fixture(scope="session", autouse=True)
def _warp() -> None:
    start()

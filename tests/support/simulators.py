"""Simulators that a test needs."""

import pytest

PACKAGES = {"mujoco": ("mujoco", "sim"), "physx": ("sapien", "physx"), "drake": ("pydrake", "drake")}
"""Package of each, and the extra that brings it."""


def need(engine: str) -> None:
    """Skip the test where a simulator is not installed."""
    package, extra = PACKAGES[engine]
    pytest.importorskip(package, reason=f"{engine} is not installed (extra {extra})", exc_type=ImportError)

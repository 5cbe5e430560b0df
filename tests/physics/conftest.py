"""A gripper around a cube, or nothing where there is no MuJoCo."""

import pytest
from reference.jaws import Jaws

from lgrasp.runtime.device import start


@pytest.fixture(scope="session", autouse=True)
def _warp() -> None:
    start()


@pytest.fixture(scope="session")
def jaws(tmp_path_factory: pytest.TempPathFactory) -> Jaws:
    pytest.importorskip("mujoco", reason="MuJoCo is not installed (extra sim)")
    return Jaws(tmp_path_factory.mktemp("jaws"))

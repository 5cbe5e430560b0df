"""Every kernel is compared with its reference on each device there is."""

import pytest

from lgrasp.runtime.device import start


@pytest.fixture(scope="session", autouse=True)
def _warp() -> None:
    start()


@pytest.fixture(scope="session", params=["cpu", "cuda:0"])
def device(request: pytest.FixtureRequest) -> str:
    import warp as wp

    start()
    if request.param != "cpu" and wp.get_cuda_device_count() == 0:
        pytest.skip("no GPU here")
    return request.param

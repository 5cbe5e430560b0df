import pytest


@pytest.fixture(params=["mujoco", "physx"])
def engine(request):
    """Each simulator."""
    if request.param == "physx":
        pytest.importorskip("sapien", reason="PhysX is not installed (extra physx)", exc_type=ImportError)
    return request.param

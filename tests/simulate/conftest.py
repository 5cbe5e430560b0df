import pytest

PACKAGES = {"mujoco": "mujoco", "physx": "sapien", "drake": "pydrake"}


@pytest.fixture(params=PACKAGES)
def engine(request):
    """Each simulator."""
    name = request.param
    pytest.importorskip(PACKAGES[name], reason=f"{name} is not installed (extra {name})", exc_type=ImportError)
    return name

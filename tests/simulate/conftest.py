import pytest
from support.simulators import PACKAGES, need


@pytest.fixture(params=PACKAGES)
def engine(request):
    """Each simulator."""
    need(request.param)
    return request.param

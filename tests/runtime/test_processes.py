"""Processes that work side by side."""

import pytest
from support.workers import leave

from lgrasp.errors import DeviceError
from lgrasp.runtime.processes import Crew


def test_a_process_that_is_lost_ends_the_others():
    with Crew(leave, [(0,), (7,)], ["one", "two"]) as crew:
        with pytest.raises(DeviceError, match="process on two ended with exit code 7"):
            crew.heard(60.0)
        assert crew.working
    assert not any(process.is_alive() for process in crew._processes)

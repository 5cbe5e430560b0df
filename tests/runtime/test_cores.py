"""Threads fit what the process may use, whatever the computer has."""

import os

import pytest

from lgrasp.runtime import cores as module
from lgrasp.runtime.cores import cores, threads


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="no affinity on this system")
@pytest.mark.parametrize(("quota", "most"), [("max 100000", 8), ("150000 100000", 2), ("5000 100000", 1), ("odd", 8)])
def test_threads_are_not_more_than_cores(monkeypatch, tmp_path, quota, most):
    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(module, "_QUOTA", tmp_path / "cpu.max")
    monkeypatch.setattr(os, "sched_getaffinity", lambda process: set(range(8)))
    monkeypatch.setattr(os, "cpu_count", lambda: 128)
    assert cores() == most
    assert [threads(asked) for asked in (0, 1, 64)] == [most, 1, most]

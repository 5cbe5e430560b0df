"""Processor cores that this process may use."""

import os
from contextlib import suppress
from pathlib import Path

_QUOTA = Path("/sys/fs/cgroup/cpu.max")


def cores() -> int:
    """How many there are: of the computer, or fewer where a cluster, ``taskset`` or a container gives fewer."""
    most = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with suppress(OSError, ValueError):
        quota, period = map(int, _QUOTA.read_text().split())  # "max" is none
        most = min(most, -(-quota // period))
    return max(most, 1)


def threads(asked: int) -> int:
    """As asked, but not more than there are cores, which would cost time and memory; 0: one a core."""
    return min(asked, cores()) if asked else cores()

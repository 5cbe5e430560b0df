"""Commands that are ended at random moments: the same files after another run, and nothing else.

``lgrasp bench soak`` does the same for hours, with all commands.
"""

from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
import warp as wp
from support.forked import start_forked

from lgrasp.bench.soak.processes import WAYS
from lgrasp.bench.soak.trials import Soak

TIMES = {"generate": 1, "dataset merge": 1}


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks for processes in /proc")
def test_random_moments(load, cache_root, tmp_path):
    load("tiny")  # what the commands begin with, and other tests
    random, ways = np.random.default_rng(15), cycle(WAYS)
    place = Soak(tmp_path, Path(wp.config.kernel_cache_dir).parent, cache=cache_root, launch=start_forked)
    found = [place.end(name, next(ways), random.uniform()) for name, times in TIMES.items() for _ in range(times)]
    assert len(found) == sum(TIMES.values())
    assert any(attack.died for attack in found)
    assert not [f"{a.command}, {a.way} at {a.moment:.3f}: {fault}" for a in found for fault in a.faults]

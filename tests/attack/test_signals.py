"""Commands that are ended at random moments: the same files after another run, and nothing else.

``lgrasp bench soak`` does the same for hours, with all commands.
"""

from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from support.forked import start_forked
from support.kernels import kernel_folder

from lgrasp.bench.soak.processes import WAYS
from lgrasp.bench.soak.trials import Soak

TIMES = {"generate": 1, "dataset merge": 1}
LATEST = 0.5  # of a duration, which the next run may fall short of


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks for processes in /proc")
def test_random_moments(load, cache_root, tmp_path):
    load("tiny")  # what the commands begin with, and other tests
    random, ways = np.random.default_rng(15), cycle(WAYS)
    place = Soak(tmp_path, kernel_folder(), cache=cache_root, launch=start_forked)
    moments = random.uniform(0.0, LATEST, sum(TIMES.values())).tolist()
    names = [name for name, times in TIMES.items() for _ in range(times)]
    found = [place.end(name, next(ways), moment) for name, moment in zip(names, moments, strict=True)]
    assert any(attack.code for attack in found)
    assert not [f"{a.command}, {a.way} at {a.moment:.3f}: {fault}" for a in found for fault in a.faults]

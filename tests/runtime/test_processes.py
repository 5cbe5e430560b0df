"""Processes that work side by side."""

import multiprocessing
import subprocess
import sys
import time

import pytest
from support.workers import leave, lost, lost_in_a_result

from lgrasp.errors import DeviceError
from lgrasp.runtime.kept import Keeper
from lgrasp.runtime.processes import Crew, ProcessPool, none_killed


def test_a_process_that_is_lost_ends_the_others():
    with Crew(leave, [(0,), (7,)], ["one", "two"]) as crew:
        ((number, error),) = crew.heard(60.0)
        assert (number, type(error)) == (1, DeviceError)
        assert "process on two ended with exit code 7" in str(error)
        assert crew.working
    assert not any(process.is_alive() for process in crew._processes)


def test_a_pool_does_not_run_the_script_again(tmp_path):
    script = tmp_path / "script.py"
    pool = "from lgrasp.runtime.processes import ProcessPool\nwith ProcessPool(2) as pool:\n    "
    script.write_text(f"print('begun')\n{pool}print(*pool.map(abs, [-1, 2]))\n")
    done = subprocess.run([sys.executable, script], check=True, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("begun\n1 2\n", "")


def test_a_pool_that_is_kept_ends_when_all_is_forgotten():
    kept = Keeper()
    pool = kept.get("pool", 1, lambda: ProcessPool(1))
    assert kept.get("pool", 1, lambda: ProcessPool(1)) is pool
    assert pool.submit(abs, -2).result() == 2
    kept.close()
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.submit(abs, -2)
    assert multiprocessing.active_children() == []


@pytest.mark.parametrize("end", [lost, lost_in_a_result])
def test_a_pool_ends_where_one_of_its_processes_was_killed(end):
    """At once, whatever the others do; an executor asks them to end by a signal that they are spared."""
    begun = time.monotonic()
    with ProcessPool(3) as pool:
        assert list(pool.map(abs, range(-8, 0)))
        pool.submit(time.sleep, 60)
        with pytest.raises(DeviceError, match="a process that works was killed"), none_killed("works"):
            pool.submit(end).result()
    assert time.monotonic() - begun < 30
    assert multiprocessing.active_children() == []


def test_what_a_pool_is_doing_is_cut_off():
    begun = time.monotonic()
    pool = ProcessPool(1)
    assert pool.submit(abs, -2).result() == 2
    for _ in range(2):
        pool.submit(time.sleep, 60)
    pool.shutdown(cancel_futures=True)
    assert time.monotonic() - begun < 30
    assert multiprocessing.active_children() == []

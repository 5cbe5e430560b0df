"""A process that is asked to stop ends, whatever it is doing, and leaves nothing."""

import os
import signal
import subprocess
import sys
import threading
import time

import pytest
from support.jaws import Jaws
from support.simulators import need

from lgrasp.dataset.writer import write_shard
from lgrasp_cli import stopping
from lgrasp_cli.progress import JobProgress
from lgrasp_cli.stopping import on_interrupt

WORK = {
    "drops exceptions": "while True:\n    try: time.sleep(1)\n    except BaseException: pass",
    "native code": "hashlib.pbkdf2_hmac('sha256', b'', b'', 2**31 - 1)",
    "tidying up": "at_end(lambda: time.sleep(60))\ntime.sleep(60)",
}


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
@pytest.mark.parametrize("work", WORK)
def test_ends(tmp_path, work, number):
    code = f"""
import hashlib, os, tempfile, time
from lgrasp.files import at_end, hold_file
from lgrasp_cli import __main__ as entry, stopping
from pathlib import Path
stopping._PATIENCE, stopping._GRACE = 0.3, 0.3
stopping.heed_signals()
entry._gather_temporaries()
tempfile.mkdtemp()
hold_file(Path("shard.h5"))
print(sorted(os.listdir()), flush=True)
{WORK[work]}
"""
    env = os.environ | {"TMPDIR": str(tmp_path)}
    command, pipe = [sys.executable, "-c", code], subprocess.PIPE
    child = subprocess.Popen(command, cwd=tmp_path, env=env, text=True, stdout=pipe, stderr=pipe)
    assert child.stdout is not None
    assert child.stdout.readline().count(".tmp") == 2
    child.send_signal(number)
    try:
        assert child.communicate(timeout=30) == ("", "interrupted\n")
    finally:
        child.kill()
    assert child.returncode == 130
    assert work == "tidying up" or not list(tmp_path.iterdir())


def test_a_signal_that_comes_twice_at_once_is_one(monkeypatch):
    """``timeout`` sends one to a process and one to its group."""
    heard: list[bool] = []
    with on_interrupt(heard.append):
        signal.raise_signal(signal.SIGTERM)
        signal.raise_signal(signal.SIGTERM)
        assert heard == [False]
        monkeypatch.setattr(stopping, "_ONE", 0.0)
        signal.raise_signal(signal.SIGINT)
        assert heard == [False, True]


def test_a_row_that_takes_long_does_not_keep_a_job_from_stopping(cli, tmp_path, monkeypatch):
    need("physx")
    from lgrasp.simulate.trial import Trial  # needs MuJoCo

    write_shard(tmp_path / "one.h5", Jaws(tmp_path).shard(0.004))
    begun, end = threading.Event(), threading.Event()
    monkeypatch.setattr(Trial, "run", lambda *_: (begun.set(), end.wait(60)))
    monkeypatch.setattr(JobProgress, "cancelled", lambda _: begun.is_set())
    started = time.monotonic()
    result = cli("simulate", "one.h5", "--engine", "physx", "--workers", 1)
    took = time.monotonic() - started
    end.set()
    assert result.code == 130
    assert result.err == "interrupted: nothing is finished; the same command begins again\n"
    assert took < 30

"""Commands as processes of their own that have lgrasp imported already, which is most of a short command's time."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from multiprocessing import get_context
from multiprocessing.context import ForkServerContext
from multiprocessing.process import BaseProcess
from pathlib import Path

_IMPORTED = ("lgrasp_cli.main", "lgrasp.jobs.generate", "lgrasp.jobs.simulate", "mujoco")


def fork_server() -> ForkServerContext:
    """Starts processes that have lgrasp imported."""
    context = get_context("forkserver")
    context.set_forkserver_preload(list(_IMPORTED))
    return context


class Forked:
    """A process that runs a command."""

    def __init__(self, process: BaseProcess) -> None:
        assert process.pid is not None
        self._process, self.pid = process, process.pid

    def wait(self, timeout: float) -> int:
        """Its exit code, negative for a signal."""
        self._process.join(timeout)
        if self._process.exitcode is None:
            raise subprocess.TimeoutExpired("lgrasp", timeout)
        return self._process.exitcode


def start_forked(arguments: Sequence[str], folder: Path, environment: Mapping[str, str], said: Path) -> Forked:
    """Start a command in a session of its own; see :func:`lgrasp.bench.soak.processes.start_process`."""
    process = fork_server().Process(target=_run, args=(list(arguments), folder, dict(environment), said))
    process.start()
    assert process.pid is not None
    while process.exitcode is None and os.getsid(process.pid) != process.pid:
        time.sleep(0.002)
    return Forked(process)


def _run(arguments: list[str], folder: Path, environment: dict[str, str], said: Path) -> None:
    from lgrasp_cli.__main__ import main

    for number in (signal.SIGINT, signal.SIGHUP):
        signal.signal(number, signal.SIG_DFL)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    tempfile.tempdir = None
    output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(output, 1)
    os.dup2(output, 2)
    sys.argv = ["lgrasp", *arguments]
    os.setsid()
    main()

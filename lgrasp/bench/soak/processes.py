"""Processes of commands: how they are started, ended and looked for."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from lgrasp.errors import LgraspError

LONGEST = 60.0
"""Seconds after which an ended command and all processes that it started must be gone."""

_LISTED = Path("/proc")
_TWICE = 0.3  # [s] between two Ctrl-C


def _twice(process: int) -> None:
    os.killpg(process, signal.SIGINT)
    time.sleep(_TWICE)
    os.killpg(process, signal.SIGINT)


WAYS: dict[str, Callable[[int], None]] = {
    "SIGTERM": lambda process: os.kill(process, signal.SIGTERM),
    "SIGINT": lambda process: os.kill(process, signal.SIGINT),
    "SIGKILL": lambda process: os.kill(process, signal.SIGKILL),
    "SIGHUP": lambda process: os.kill(process, signal.SIGHUP),
    "Ctrl-C": lambda process: os.killpg(process, signal.SIGINT),
    "Ctrl-C twice": _twice,
    "SIGTERM to all": lambda process: os.killpg(process, signal.SIGTERM),
}
"""How a command is ended; Ctrl-C on a terminal reaches the processes that the command started, too."""


class Running(Protocol):
    """A command that was started, in a session of its own."""

    pid: int

    def wait(self, timeout: float) -> int:
        """Its exit code, negative for a signal.

        Raises:
            subprocess.TimeoutExpired: it still runs.
        """
        ...


Launch = Callable[[Sequence[str], Path, Mapping[str, str], Path], Running]
"""Start a command: arguments, current folder, environment, file of its output."""


def start_process(arguments: Sequence[str], folder: Path, environment: Mapping[str, str], said: Path) -> Running:
    """Start the command as a user does on a terminal: no signal is ignored, even if this process runs in ``nohup``."""
    before = {number: signal.signal(number, signal.SIG_DFL) for number in (signal.SIGINT, signal.SIGHUP)}
    try:
        with open(said, "wb") as file:
            return subprocess.Popen(
                [sys.executable, "-m", "lgrasp_cli", *arguments],
                cwd=folder,
                env=environment,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=file,
                start_new_session=True,
            )
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def wait(running: Running, patience: float = LONGEST) -> int:
    """The exit code; a command that does not end is killed, with its session.

    Raises:
        LgraspError: it did not end.
    """
    try:
        return running.wait(patience)
    except subprocess.TimeoutExpired:
        kill(running)
        raise LgraspError(f"process {running.pid} did not end within {patience:g} s") from None


def kill(running: Running) -> None:
    """End a command, with its session, at once."""
    with suppress(ProcessLookupError):
        os.killpg(running.pid, signal.SIGKILL)


def check_system() -> None:
    """Check that processes can be looked for.

    Raises:
        LgraspError: a system that does not list them.
    """
    if not (_LISTED / "self").exists():
        raise LgraspError(f"processes are looked for in {_LISTED}, which this system does not have; Linux has it")


def catches(process: int, number: int) -> bool:
    """True if a process handles a signal, or is gone."""
    try:
        status = (_LISTED / str(process) / "status").read_text()
        return bool(int(status.partition("SigCgt:")[2].split()[0], 16) >> (number - 1) & 1)
    except (OSError, IndexError):
        return True


def processes(session: int, marked: bytes) -> Iterator[str]:
    """Processes of a session, or with a word in their environment, as number and command line."""
    for folder in _LISTED.iterdir():
        if not folder.name.isdecimal() or int(folder.name) == os.getpid():
            continue
        with suppress(OSError, ValueError, IndexError):
            state, *_, own = (folder / "stat").read_text().rpartition(")")[2].split()[:4]
            if state != "Z" and (int(own) == session or marked in (folder / "environ").read_bytes()):
                words = (folder / "cmdline").read_bytes().split(bytes(1))
                yield f"{folder.name} {b' '.join(words).decode(errors='replace')}"

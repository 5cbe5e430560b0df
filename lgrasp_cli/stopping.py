"""Signals that ask the process to stop: it ends at once, or as a running job wants it, but soon in any case."""

import _thread
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

from lgrasp.signals import stop_signals

_PATIENCE = 5.0  # [s] that a job may take to leave what it is making
_GRACE = 1.0  # [s] that tidying up may take
_ONE = 0.2  # [s] within which two signals are one: some programs send them to a process and then to its group

_errors = 2  # standard error


def heed_signals() -> None:
    """End this process when it is asked to stop: between two steps of the main thread; or, if that is in native code or
    a job takes its time, when it is asked again or after five seconds."""
    global _errors
    with suppress(OSError):  # closed
        _errors = os.dup(2)  # what native code writes to 2 may be caught for a while
    reading, writing = os.pipe()
    os.set_blocking(writing, False)
    signal.set_wakeup_fd(writing, warn_on_full_buffer=False)
    numbers = stop_signals()
    with suppress(RuntimeError):  # no more threads are allowed
        _thread.start_new_thread(_watch, (reading, frozenset(numbers)))
    for number in numbers:
        signal.signal(number, lambda number, frame: stop_now())


def _watch(reading: int, numbers: frozenset[int]) -> None:
    def heard() -> bool:
        return bool(numbers.intersection(os.read(reading, 64)))

    while not heard():
        pass
    first = time.monotonic()
    while select.select([reading], [], [], _PATIENCE)[0]:
        if heard() and time.monotonic() - first > _ONE:
            break
    stop_now()


def stop_now() -> None:
    """End this process: its files are whole or absent, its temporary ones are removed.

    Nothing is raised: an exception out of a signal handler may meet code that drops it, such as a callback of h5py in
    the middle of a write, and the command would go on.
    """
    _thread.start_new_thread(_leave, (_GRACE,))
    with suppress(Exception):  # not loaded yet
        sys.modules["lgrasp.files"].discard_temporaries()
    _leave(0.0)


def _leave(seconds: float) -> None:
    time.sleep(seconds)
    tell("interrupted")
    os._exit(130)


def tell(line: str) -> None:
    """Print a line on standard error from a signal handler, which may have interrupted another one."""
    with suppress(OSError):
        os.write(_errors, f"{line}\n".encode())


@contextmanager
def on_interrupt(action: Callable[[bool], None]) -> Iterator[None]:
    """Call ``action`` on the signals that ask to stop inside the block, if this is the main thread; with True if it was
    called before."""
    first = 0.0

    def handler(number: int, frame: FrameType | None) -> None:
        nonlocal first
        again, first = bool(first), first or time.monotonic()
        if not again or time.monotonic() - first > _ONE:
            action(again)

    before = {}
    with suppress(ValueError):
        before = {number: signal.signal(number, handler) for number in stop_signals()}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)

"""Handling of Ctrl-C and SIGTERM."""

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType

_GRACE = 1.0  # [s] that native code may take before the process is ended
_last: list[Callable[[], None]] = []  # what is still done then
_asked = threading.Event()


class Interrupted(BaseException):
    """The user stopped the command."""


def stop_now() -> None:
    """Unwind to the end of the command, and end the process where that takes longer than a second.

    Raises:
        Interrupted: always.
    """
    _asked.set()
    last = threading.Timer(_GRACE, _end)
    last.daemon = True
    last.start()
    raise Interrupted


def stop_asked() -> bool:
    """True if :func:`stop_now` was called; a module half-imported then may fail later in unrelated ways."""
    return _asked.is_set()


@contextmanager
def before_end(action: Callable[[], None]) -> Iterator[None]:
    """Call ``action`` if the process is ended inside the block before the main thread could unwind it."""
    _last.append(action)
    try:
        yield
    finally:
        _last.remove(action)


def _end() -> None:
    for action in list(_last):
        with suppress(Exception):
            action()
    sys.stderr.write("interrupted\n")
    sys.stderr.flush()
    os._exit(130)


@contextmanager
def on_interrupt(action: Callable[[], None]) -> Iterator[None]:
    """Call ``action`` on SIGINT and SIGTERM inside the block."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handler(number: int, frame: FrameType | None) -> None:
        action()

    before = {number: signal.signal(number, handler) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)

"""The signals that ask a program to stop, and processes that leave them to the one that started them."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

_ASKING = ("SIGINT", "SIGTERM", "SIGHUP")  # Ctrl-C; kill and batch systems; a terminal that is closed


def stop_signals() -> list[signal.Signals]:
    """The signals that ask to stop, without those that whoever started this process told it to ignore (``nohup``, ``&``
    in scripts)."""
    known = [signal.Signals[name] for name in _ASKING if hasattr(signal, name)]
    return [number for number in known if signal.getsignal(number) is not signal.SIG_IGN]


@contextmanager
def spared() -> Iterator[None]:
    """Processes that are started inside the block do not get the signals that ask to stop.

    A terminal and batch systems send them to all processes of a job; a helper that ends by itself looks like a failure
    to the process that waits for it.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, stop_signals())
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)

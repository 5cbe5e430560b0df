"""Threads that share a GPU take turns on its one stream: a graph being captured takes in all that is launched there,
and the arrays of a graph stay as they are only until it is replayed.
"""

import sys
import threading
import time
from collections.abc import Generator
from contextlib import contextmanager

_SWITCH = 0.0005  # [s] of 5 ms by default, which many launches would wait in turn

_own = threading.local()


def waited() -> float:
    """How long this thread has waited for its turns so far [s]."""
    return getattr(_own, "waited", 0.0)


class Turn:
    """Held by the one thread that may launch; others wait for it.

    That thread gives up Python's lock with every launch, and others that finish rows soon give it back.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        sys.setswitchinterval(_SWITCH)

    def __enter__(self) -> None:
        begin = time.perf_counter()
        self._lock.acquire()
        _own.turn, _own.waited = self, waited() + time.perf_counter() - begin

    def __exit__(self, *error: object) -> None:
        _own.turn = None
        self._lock.release()


@contextmanager
def others_turn() -> Generator[None]:
    """Others may launch while this thread waits; it goes on when it is its turn again, if it had it."""
    turn: Turn | None = getattr(_own, "turn", None)
    if turn is None:
        yield
        return
    turn.__exit__()
    try:
        yield
    finally:
        turn.__enter__()

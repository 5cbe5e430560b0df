"""Notices for the user that are not errors: each is reported once per process, to all listeners; in a program that has
none they are warnings."""

import multiprocessing
import warnings
from collections.abc import Callable

_said: set[str] = set()
_listeners: list[Callable[[str], None]] = []


def on_notice(listener: Callable[[str], None]) -> None:
    """Give every notice that comes from now on to ``listener``; the command line prints them on standard error."""
    _listeners.append(listener)


def notice(line: str) -> None:
    """Report a line, unless it is empty or was reported before; processes that work for another say nothing."""
    if not line or line in _said:
        return
    if not _listeners:
        if multiprocessing.parent_process() is None:
            warnings.warn(line, stacklevel=2)
        return
    _said.add(line)
    for listener in _listeners:
        listener(line)

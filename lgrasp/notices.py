"""Notices for the user that are not errors: each is reported once per process, to all listeners."""

from collections.abc import Callable

_said: set[str] = set()
_listeners: list[Callable[[str], None]] = []


def on_notice(listener: Callable[[str], None]) -> None:
    """Give every notice that comes from now on to ``listener``; the command line prints them on standard error."""
    _listeners.append(listener)


def notice(line: str) -> None:
    """Report a line, unless it is empty, was reported before, or there is no listener."""
    if not line or line in _said or not _listeners:
        return
    _said.add(line)
    for listener in _listeners:
        listener(line)

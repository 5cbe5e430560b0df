"""Lines for the user that are no errors: each is said once a process, to whoever listens."""

from collections.abc import Callable

_said: set[str] = set()
_listeners: list[Callable[[str], None]] = []


def on_notice(listener: Callable[[str], None]) -> None:
    """Give every notice that comes from now on to ``listener``; the command line prints them on standard error."""
    _listeners.append(listener)


def notice(line: str) -> None:
    """Say a line, unless it was said before or nobody listens."""
    if line in _said or not _listeners:
        return
    _said.add(line)
    for listener in _listeners:
        listener(line)

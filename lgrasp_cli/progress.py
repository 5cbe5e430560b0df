"""While a job runs: one stream of progress on standard error, Ctrl-C to stop after the current batch."""

import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import typer

from lgrasp.engine.events import Events
from lgrasp.files import at_end
from lgrasp_cli.stopping import on_interrupt, stop_now, tell

if TYPE_CHECKING:
    from lgrasp.engine.events import Made, Part

_PLAIN_INTERVAL = 10.0  # [s] between lines when standard error is no terminal


def say(line: str) -> None:
    """Print a line of progress on standard error."""
    typer.echo(line, err=True)


class Bar:
    """How far something is: a bar on a terminal, else a plain line every ten seconds, or nothing.

    Args:
        quiet: show nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._said = time.monotonic()
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> "Bar":
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._bar = Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True))
            self._task = self._bar.add_task("", total=None, note="")
            at_end(self._bar.stop)  # which shows the cursor
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def show(self, what: str, done: int | None = None, total: int = 0, note: str = "") -> None:
        """Show the current activity, and how much is done if that is known."""
        if self._bar:
            whole = total if done is not None and total else None
            self._bar.update(self._task, description=what, completed=done or 0, total=whole, note=note)
        elif not self._quiet and time.monotonic() - self._said >= _PLAIN_INTERVAL:
            self._said = time.monotonic()
            count = "" if done is None else f" {done:,}/{total:,}"
            say(f"{what}{count} {note}".rstrip())

    def say(self, line: str) -> None:
        """Print a line that stays."""
        if self._bar:
            self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif not self._quiet:
            say(line)

    def share(self, what: str, share: float) -> None:
        """Tell what is being loaded or made, and how much of it is done, from 0 to 1."""
        self.show("loading", note=f"{what} {share:.0%}" if share else what)


class JobProgress(Events):
    """What a job tells, on a bar.

    Args:
        unit: what the job counts.
    """

    def __init__(self, bar: Bar, unit: str) -> None:
        self.stop = self.running = False
        self._bar, self._unit = bar, unit
        self._rows: dict[int, int] = {}  # done, by part
        self._asked = 0

    def said(self, words: str) -> None:
        self._bar.say(words)

    def loading(self, what: str, share: float = 0.0) -> None:
        self._bar.share(what, share)

    def started(self, parts: "Sequence[Part]", present: Mapping[int, int]) -> None:
        self.running = True
        self._asked, self._rows = sum(part.rows for part in parts), dict(present)

    def advanced(self, part: "Part", done: int, note: str = "") -> None:
        self._rows[part.number] = done
        self._bar.show(f"{self._unit} ({part.file.name})", sum(self._rows.values()), self._asked, note)

    def wrote(self, part: "Part", made: "Made") -> None:
        self._rows[part.number] = max(made.rows, self._rows.get(part.number, 0))

    def cancelled(self) -> bool:
        return self.stop


@contextmanager
def interruptible(progress: JobProgress) -> Iterator[JobProgress]:
    """The first Ctrl-C (or SIGTERM, SIGHUP) ends the job as soon as it can, the second, or five seconds, at once.

    Whole files stay, what is being made is dropped.
    """

    def stop(again: bool) -> None:
        if again or not progress.running:
            stop_now()
        progress.stop = True
        tell("stopping after the current batch; press Ctrl-C again to stop at once")

    with on_interrupt(stop):
        yield progress

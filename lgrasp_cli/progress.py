"""While a job runs: one stream of progress on standard error, Ctrl-C to stop after the current batch."""

import sys
import threading
import time
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import TYPE_CHECKING, Any

import typer

from lgrasp.engine.events import Events
from lgrasp.files import at_end
from lgrasp_cli.stopping import on_interrupt, stop_now, tell

if TYPE_CHECKING:
    from lgrasp.engine.events import Made, Part

_PLAIN_INTERVAL = 10.0  # [s] between lines when standard error is no terminal
_LOOK_BACK = 60.0  # [s] over which speed is measured
_FIXED = 16  # characters of a bar's line: the shortest bar, the time, spaces


def say(line: str) -> None:
    """Print a line of progress on standard error."""
    typer.echo(line, err=True)


class Bar:
    """How far something is, and when it will be done: a bar on a terminal, else a line every ten seconds;
    nothing where it is ``quiet``."""

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._said = time.monotonic()
        self._went: deque[tuple[float, float]] = deque()  # when, how far: of the last minute
        self._what: Any = None
        self._begun = False  # something of it was done
        self._bar: Any = None
        self._task: Any = None

    def __enter__(self) -> "Bar":
        if not self._quiet and sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
            from rich.table import Column

            def text(field: str) -> TextColumn:
                return TextColumn(f"{{task.{field}}}", markup=False)

            # the bar gives way, nothing else is cut
            elapsed = TimeElapsedColumn(Column(no_wrap=True))
            columns = text("description"), BarColumn(None), text("fields[count]"), elapsed, text("fields[tail]")
            self._bar = Progress(*columns, console=Console(stderr=True))
            self._task = self._bar.add_task("", total=None, count="", tail="")
            at_end(self._bar.stop)  # which shows the cursor
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def show(
        self, what: str, done: int | None = None, total: int = 0, note: str = "", ahead: float = 0.0, kept: int = 0
    ) -> None:
        """Show the current activity, and how much is done if that is known.

        Args:
            ahead: how many more what is being made now is worth.
            kept: how many were done before this run.
        """
        if done is None:
            self._tell(what, "", None, note)
        elif not total:
            self._tell(what, f"{done:,}", None, note)
        else:
            speed = self._speed(what, total, done - kept + ahead)
            rate = f"{speed:,.0f}/s" if speed > 9.95 else f"{speed:.1f}/s" if speed > 0.2 else f"{60 * speed:.1f}/min"
            left = f"{_time((total - done - ahead) / speed)} left  {rate}" if speed and done < total else ""
            self._tell(what, f"{done:,}/{total:,}", (done + ahead) / total, "  ".join(filter(None, (left, note))))

    def share(self, what: str, share: float) -> None:
        """Tell what is being loaded or made, and how much of it is done, from 0 to 1."""
        speed = self._speed(what.split()[0], 1, share)
        left = f"{_time((1 - share) / speed)} left" if speed else ""
        self._tell("loading", f"{share:.0%}" if share else "", share or None, "  ".join(filter(None, (left, what))))

    def say(self, line: str) -> None:
        """Print a line that stays."""
        if self._bar:
            self._bar.console.print(line, markup=False, highlight=False, soft_wrap=True)
        elif not self._quiet:
            say(line)

    def _speed(self, *at: Any) -> float:
        """How much is done in a second, from the first result on (what is prepared before it takes time only once); 0
        if not known yet. ``at``: what it is that goes on, and how much of it was done in this run."""
        *what, done = at
        last = self._went[-1][1] if self._went else done
        if what != self._what:
            self._what, self._begun = what, False
            self._went.clear()
        elif done < last or (done > last and not self._begun):
            self._begun = self._begun or done > last
            self._went.clear()
        self._went.append((time.monotonic(), done))
        while len(self._went) > 2 and self._went[-1][0] - self._went[1][0] > _LOOK_BACK:
            self._went.popleft()
        (begin, first), (end, last) = self._went[0], self._went[-1]
        return max(last - first, 0.0) / (end - begin) if end > begin else 0.0

    def _tell(self, what: str, count: str, share: float | None, tail: str) -> None:
        if self._bar:
            room = self._bar.console.width - len(what) - len(count) - _FIXED
            tail = tail if len(tail) <= room else tail[: max(room - 1, 0)] + "…"
            task = self._bar.tasks[0]
            task.total = None if share is None else 1.0
            self._bar.update(self._task, description=what, completed=share or 0.0, count=count, tail=tail)
            task.finished_time = None  # the clock goes on: what is full may be the first of many
        elif not self._quiet and time.monotonic() - self._said >= _PLAIN_INTERVAL:
            self._said = time.monotonic()
            say("  ".join(filter(None, (what, count, tail))))


def _time(seconds: float) -> str:
    """1:02:03"""
    return str(timedelta(seconds=round(seconds)))


class JobProgress(Events):
    """What a job tells, on a bar."""

    def __init__(self, bar: Bar, unit: str) -> None:
        self.stop = self.running = False
        self._bar, self._unit = bar, unit
        self._lock = threading.Lock()  # held while the bar is changed
        self._parts: dict[int, tuple[int, int, int]] = {}  # of each done, asked, and done before this run

    def said(self, words: str) -> None:
        self._bar.say(words)

    def loading(self, what: str, share: float = 0.0) -> None:
        self._bar.share(what, share)

    def started(self, parts: "Sequence[Part]", present: Mapping[int, int]) -> None:
        self.running = True
        there = [(part, present.get(part.number, 0)) for part in parts]
        self._parts = {part.number: (done, part.rows, done) for part, done in there}
        self._show()

    def advanced(self, part: "Part", done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        with self._lock:
            self._parts[part.number] = done, part.rows, kept
            self._show(note, ahead)

    def wrote(self, part: "Part", made: "Made") -> None:
        with self._lock:
            done, asked, kept = self._parts.get(part.number, (0, 0, 0))
            self._parts[part.number] = max(made.rows, done), asked, kept
            self._show()

    def _show(self, note: str = "", ahead: float = 0.0) -> None:
        done, total, kept = map(sum, zip((0, 0, 0), *self._parts.values(), strict=True))
        self._bar.show(self._unit, done, total, note, ahead, kept)

    def cancelled(self) -> bool:
        return self.stop


@contextmanager
def interruptible(progress: JobProgress) -> Iterator[JobProgress]:
    """The first Ctrl-C (or SIGTERM, SIGHUP) ends the job as soon as it can, the second, or five seconds, at once.

    Whole files stay, and what the job keeps of the next.
    """

    def stop(again: bool) -> None:
        if again or not progress.running:
            stop_now()
        progress.stop = True
        tell("stopping; press Ctrl-C again to stop at once")

    with on_interrupt(stop):
        yield progress

"""While a job runs: progress on standard error, Ctrl-C to stop after the running batch."""

import sys
import time
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from lgrasp.engine.report import survivors
from lgrasp.jobs.generate import Listener
from lgrasp_cli.interrupt import on_interrupt, stop_now

if TYPE_CHECKING:
    from pathlib import Path

    from lgrasp.engine.shard import Found

_PLAIN_INTERVAL = 10.0  # [s] between lines when standard error is no terminal


def say(line: str) -> None:
    """Print a line of progress on standard error."""
    typer.echo(line, err=True)


class JobProgress(Listener):
    """Progress of a job: a bar on a terminal, else a plain line every ten seconds, or nothing.

    Args:
        shards: rows of every shard of this job.
        quiet: show nothing.
    """

    def __init__(self, shards: dict[int, int], *, quiet: bool = False) -> None:
        self.stop = False
        self.running = False
        self._shards = shards
        self._asked = sum(shards.values())
        self._done = 0  # rows of finished shards
        self._quiet = quiet
        self._start = self._said = time.monotonic()
        self._bar: Progress | None = None
        self._task: Any = None

    def __enter__(self) -> "JobProgress":
        if not self._quiet and sys.stderr.isatty():
            columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
            self._bar = Progress(*columns, TextColumn("{task.fields[note]}"), console=Console(stderr=True))
            self._task = self._bar.add_task("loading", total=None, note="")
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar:
            self._bar.stop()

    def _show(self, what: str, done: int | None, note: str) -> None:
        if self._bar:
            total = self._asked if done is not None else None
            self._bar.update(self._task, description=what, completed=done or 0, total=total, note=note)
        elif not self._quiet and time.monotonic() - self._said >= _PLAIN_INTERVAL:
            self._said = time.monotonic()
            say(f"{what} {note}" if done is None else f"{what} {done:,}/{self._asked:,} {note}")

    def loading(self, what: str, share: float) -> None:
        self._show("loading", None, f"{what} {share:.0%}" if share else what)

    def started(self, inputs: Any, shards: list[int], present: list[int]) -> None:
        self.running = True
        self._done = sum(self._shards[s] for s in present)
        self._start = time.monotonic()

    def advanced(self, shard: int, rows: int, result: "Found") -> None:
        per_second = rows / max(time.monotonic() - self._start, 1e-9)
        flow = "  ".join(f"{stage} {count:,}" for stage, count in survivors(result.counts).items())
        self._show(f"shard {shard}", self._done + rows, f"{per_second:,.0f}/s  {flow}")

    def wrote(self, shard: int, path: "Path", result: "Found") -> None:
        self._done += len(result)
        self._start = time.monotonic()

    def cancelled(self) -> bool:
        return self.stop


def interruptible(progress: JobProgress) -> AbstractContextManager[None]:
    """The first Ctrl-C (or SIGTERM) ends the job after the running batch, the second at once; whole shards stay."""

    def stop() -> None:
        if progress.stop or not progress.running:
            stop_now()
        progress.stop = True
        say("stopping after the running batch; Ctrl-C again stops at once")

    return on_interrupt(stop)

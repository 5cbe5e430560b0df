"""Common parts of all commands that make files: their options, and how a job is run, reported and concluded."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from lgrasp_cli.options import CacheDir, JsonPath, Quiet, check_report, open_cache, warn
from lgrasp_cli.tables import Block, plural, print_report, with_options

if TYPE_CHECKING:
    from lgrasp.engine.cache import Cache
    from lgrasp.engine.run import Job, JobOutcome

_OPTIONS: dict[str, tuple[Any, Any]] = {
    "device": (Annotated[str | None, Option(help="auto, cpu or cuda:N.")], None),
    "workers": (Annotated[int | None, Option(min=0, help="Threads or processes; 0: by device.")], None),
    "shard_index": (
        Annotated[
            int | None,
            Option(help="Number of this array task, which makes every NUMth file; default: SLURM_ARRAY_TASK_ID."),
        ],
        None,
    ),
    "num_shards": (Annotated[int | None, Option(help="Number of array tasks; default: SLURM_ARRAY_TASK_COUNT.")], None),
    "overwrite": (
        Annotated[bool, Option("--overwrite", help="Replace existing files; by default complete ones are kept.")],
        False,
    ),
    "rebuild": (Annotated[bool, Option("--rebuild", help="Rebuild cached inputs.")], False),
    "resume": (Annotated[bool, Option("--resume/--no-resume", hidden=True)], True),
    "force": (Annotated[bool, Option("--force", hidden=True)], False),
    "json_path": (JsonPath, None),
    "cache_dir": (CacheDir, None),
    "quiet": (Quiet, False),
}


@dataclass(frozen=True)
class How:
    """How a job is run, as the options say."""

    cache: "Cache"
    device: str | None
    workers: int | None
    array: tuple[int, int]
    overwrite: bool
    json_path: str | None
    quiet: bool

    def rotated(self, number: int) -> "How":
        """The same for one of several jobs: tasks of an array begin to share the parts of each with another task."""
        index, tasks = self.array
        return replace(self, array=((index - number) % max(tasks, 1) if 0 <= index < tasks else index, tasks))

    def job(self, kind: "type[Job]", where: str, /, **given: Any) -> "Job":
        """A job of some kind; options that are None are left to its defaults.

        Raises:
            ConfigError: a value out of range.
        """
        from lgrasp.config import parse_model

        asked = given | {"device": self.device, "workers": self.workers, "cache": self.cache}
        return parse_model(kind, {name: value for name, value in asked.items() if value is not None}, where)

    def run(self, job: "Job", show: Callable[[dict[str, Any]], Sequence[Block]]) -> None:
        """Run a job with progress, report it, and leave with its exit code if it fell short.

        Args:
            show: its report to be read.
        """
        check_report(self.json_path)
        data, outcome = run_job(job, self)
        print_report(data, self.json_path, () if self.quiet or self.json_path == "-" else show(data))
        conclude(data, outcome)


def working(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose argument ``how`` is a :class:`How`: it gets the options that all jobs share."""

    def run(**given: Any) -> None:
        options = {name: given.pop(name) for name in _OPTIONS}
        command(**given, how=_how(**options))

    return with_options(command, _OPTIONS, run, without="how")


def _how(
    *,
    shard_index: int | None,
    num_shards: int | None,
    overwrite: bool,
    rebuild: bool,
    resume: bool,
    force: bool,
    cache_dir: Path | None,
    **rest: Any,
) -> How:
    if not resume:
        warn("--no-resume is now called --overwrite; the old name works in this release only")
    if force:
        warn(
            "--force is now --overwrite (files that are there) and --rebuild (the cache); it works in this release only"
        )
    cache = open_cache(cache_dir, fresh=rebuild or force)
    from lgrasp.engine.run import array_task

    return How(cache, array=array_task(shard_index, num_shards), overwrite=overwrite or force or not resume, **rest)


def run_job(job: "Job", how: How) -> tuple[dict[str, Any], "JobOutcome"]:
    """Run a job with progress; its report and outcome."""
    from lgrasp.engine.report import job_report
    from lgrasp.engine.run import run
    from lgrasp_cli.progress import Bar, JobProgress, interruptible

    with Bar(quiet=how.quiet) as bar:
        progress = JobProgress(bar, job.unit)
        with interruptible(progress):
            outcome = run(job, progress, array=how.array, resume=not how.overwrite)
    return job_report(outcome), outcome


def conclude(data: dict[str, Any], outcome: "JobOutcome") -> None:
    """Leave with the exit code of a job that fell short.

    Raises:
        LgraspError: less came out than was asked.
    """
    if outcome.cancelled:
        files = plural(len(outcome.paths), "finished file")
        typer.echo(f"interrupted: {files} in {data['out']}. Run the same command again to resume", err=True)
        raise typer.Exit(130)
    error = outcome.job.shortfall(outcome)
    if error:
        raise error

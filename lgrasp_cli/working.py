"""Common parts of all commands that make files: their options, and how a job is run, reported and concluded."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from lgrasp_cli.options import CacheDir, JsonPath, Quiet, check_report, given, open_cache, with_options
from lgrasp_cli.tables import Block, plural, print_report

if TYPE_CHECKING:
    from lgrasp.engine.cache import Cache
    from lgrasp.engine.run import Job, JobOutcome


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

    def job(self, kind: "type[Job]", where: str, /, **options: Any) -> "Job":
        """A job of some kind; options that are None are left to its defaults.

        Raises:
            ConfigError: a value out of range.
        """
        from lgrasp.config import parse_model

        shared = given(device=self.device, workers=self.workers, cache=self.cache)
        return parse_model(kind, given(**options) | shared, where)

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

    def run(
        *,
        device: Annotated[str | None, Option(help="auto, cpu or cuda:N.")] = None,
        workers: Annotated[int | None, Option(min=0, help="Threads or processes; 0: by device.")] = None,
        shard_index: Annotated[
            int | None,
            Option(help="Number of this array task, which makes every NUMth file; default: SLURM_ARRAY_TASK_ID."),
        ] = None,
        num_shards: Annotated[
            int | None, Option(help="Number of array tasks; default: SLURM_ARRAY_TASK_COUNT.")
        ] = None,
        overwrite: Annotated[
            bool, Option("--overwrite", help="Replace existing files; by default complete ones are kept.")
        ] = False,
        rebuild: Annotated[bool, Option("--rebuild", help="Rebuild cached inputs.")] = False,
        json_path: JsonPath = None,
        cache_dir: CacheDir = None,
        quiet: Quiet = False,
        **options: Any,
    ) -> None:
        cache = open_cache(cache_dir, fresh=rebuild)
        from lgrasp.engine.run import array_task

        array = array_task(shard_index, num_shards)
        command(**options, how=How(cache, device, workers, array, overwrite, json_path, quiet))

    return with_options(run, command)


def run_job(job: "Job", how: How) -> tuple[dict[str, Any], "JobOutcome"]:
    """Run a job with progress; its report and outcome."""
    from lgrasp.engine.report import job_report
    from lgrasp.engine.run import run
    from lgrasp_cli.progress import Bar, JobProgress, interruptible

    with Bar(quiet=how.quiet) as bar, interruptible(JobProgress(bar, job.unit)) as progress:
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
    if error := outcome.job.shortfall(outcome):
        raise error

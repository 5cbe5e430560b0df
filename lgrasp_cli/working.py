"""Common parts of all commands that make files: their options, and how a job is run, reported and concluded."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Option

from lgrasp.words import plural
from lgrasp_cli.names import DEVICES
from lgrasp_cli.options import CacheDir, JsonPath, Quiet, check_report, given, open_cache, with_options
from lgrasp_cli.tables import Block, print_report

if TYPE_CHECKING:
    from lgrasp.engine.cache import Cache
    from lgrasp.engine.events import Events, JobOutcome
    from lgrasp.engine.request import Request
    from lgrasp.engine.run import Job
    from lgrasp.runtime.array import Array


Show = Callable[[dict[str, Any]], Sequence[Block]]
"""What is shown of the report of a job."""


_CHECKED: ContextVar[list[tuple[int, str]] | None] = ContextVar("checked", default=None)


@contextmanager
def only_checked() -> "Iterator[list[tuple[int, str]]]":
    """Commands check their jobs in the block and run none; number of parts of each job, and the device that it has
    without an option, once they are checked."""
    found: list[tuple[int, str]] = []
    token = _CHECKED.set(found)
    try:
        yield found
    finally:
        _CHECKED.reset(token)


def merely_checked(requests: "Sequence[Request]", cache: "Cache") -> bool:
    """True in a block of :func:`only_checked`: jobs are checked now.

    Raises:
        LgraspError: a value, a name or a path that cannot be.
    """
    found = _CHECKED.get()
    if found is None:
        return False
    from lgrasp.engine.run import Job
    from lgrasp.outputs import check_folder

    for request in requests:
        request.check()
        job = request if isinstance(request, Job) else request.job(cache)
        found.append((len(job.parts()), job.device))
        check_folder(job.folder)
    return True


@dataclass(frozen=True)
class How:
    """How a job is run, as the options say."""

    cache: "Cache"
    device: str | None
    workers: int | None
    array: "Array"
    overwrite: bool
    json_path: str | None
    quiet: bool
    verbose: bool
    devices: str | None = None
    """Several devices, as the option names them."""
    outcome: "Callable[[Job, Events], JobOutcome] | None" = None
    """Has those devices run the job."""

    @contextmanager
    def spread(self, jobs: "Sequence[Request]") -> "Iterator[list[How]]":
        """The same for each of several jobs, on all devices while the block runs.

        Raises:
            DeviceError: a device that does not exist.
        """
        each = self.of_each(jobs)
        if self.devices is None:
            yield each
            return
        from lgrasp.jobs.lanes import Lanes
        from lgrasp.runtime.device import resolve_devices

        devices, arrays = resolve_devices(self.devices), [how.array for how in each]
        if len(devices) == 1:
            yield each
            return
        with Lanes(devices, jobs, arrays, self.cache, resume=not self.overwrite) as lanes:
            yield [replace(how, outcome=partial(lanes.outcome, number)) for number, how in enumerate(each)]

    def of_each(self, jobs: "Sequence[Request]") -> "list[How]":
        """The same for each of several jobs, whose parts the tasks of an array share like those of one."""
        if len(jobs) == 1 or not (self.array.slurm or self.array.tasks > 1 or self.devices):
            return [self] * len(jobs)
        *before, total = accumulate((_parts(job, self.cache) for job in jobs), initial=0)
        return [replace(self, array=self.array._replace(before=number, total=total)) for number in before]

    def job(self, kind: "type[Request]", where: str, /, **options: Any) -> "Job":
        """A job of some kind, checked before what makes it is imported; options that are None are left to its defaults.

        Raises:
            LgraspError: a value, a name or a path that cannot be.
        """
        from lgrasp.config import parse_model

        return self.checked(parse_model(kind, given(**options) | self.shared, where))

    def checked(self, request: "Request") -> "Job":
        """The job of a request, the only one, that is checked before what makes it is imported.

        Raises:
            LgraspError: a value, a name or a path that cannot be, or more tasks of SLURM than parts.
        """
        request.check()
        self.array.check_early(request.known_parts, request.part)
        return request.job(self.cache)

    @property
    def shared(self) -> dict[str, Any]:
        """Fields of all requests, those that are given."""
        return given(device=self.device, workers=self.workers)

    def run(self, job: "Job", show: Show, profile: Show = lambda data: ()) -> None:
        """Run a job with progress, report it, and leave with its exit code if it fell short.

        Args:
            show: what a user decides by, of its report.
            profile: what --verbose adds.
        """
        if merely_checked([job], self.cache):
            return
        with self.spread([job]) as (how,):
            data, outcome = run_job(job, how)
        nothing = self.quiet or self.json_path == "-" or (outcome.cancelled and not outcome.paths)
        blocks = () if nothing else [*show(data), *((*profile(data), _used(data)) if self.verbose else ())]
        print_report(data, self.json_path, blocks)
        conclude(outcome, how)


def working(command: Callable[..., None]) -> Callable[..., None]:
    """A command whose argument ``how`` is a :class:`How`: it gets the options that all jobs share."""

    def run(
        *,
        device: Annotated[
            str | None,
            Option(
                help="auto: the first GPU, else the CPU; all: every GPU at once, or several, such as cuda:0,cuda:1.",
                show_default="auto",
                **DEVICES,
            ),
        ] = None,
        workers: Annotated[int | None, Option(min=0, help="Threads or processes; 0: as suits the device.")] = None,
        array: Annotated[
            str,
            Option(
                metavar="auto|off|I/N",
                help="Share the files with other tasks: I/N is task I of N, counted from 0; auto: as the SLURM job "
                "array says, if there is one.",
            ),
        ] = "auto",
        shard_index: Annotated[int | None, Option(hidden=True)] = None,
        num_shards: Annotated[int | None, Option(hidden=True)] = None,
        overwrite: Annotated[
            bool, Option("--overwrite", help="Replace existing files; by default complete ones are kept.")
        ] = False,
        rebuild: Annotated[bool, Option("--rebuild", help="Rebuild cached inputs.")] = False,
        json_path: JsonPath = None,
        cache_dir: CacheDir = None,
        quiet: Quiet = False,
        verbose: Annotated[
            bool,
            Option("--verbose", "-v", help="Also print where time and memory went, and where candidates were lost."),
        ] = False,
        **options: Any,
    ) -> None:
        check_report(json_path)
        from lgrasp.config import split_devices
        from lgrasp.runtime.array import parse_array
        from lgrasp.runtime.driver import check_driver

        if shard_index is not None or num_shards is not None:
            from lgrasp.notices import notice

            array = f"{shard_index or 0}/{1 if num_shards is None else num_shards}"
            notice(f"--shard-index and --num-shards are now --array {array}; the old names work in this release only")
        if _CHECKED.get() is not None:  # devices and tasks are those of another computer
            device, array = None, "off"
        shares = parse_array(array)
        cache = open_cache(cache_dir, fresh=rebuild)
        several, first = split_devices(device)
        check_driver(first)
        command(
            **options, how=How(cache, first, workers, shares, overwrite, json_path, quiet, verbose, devices=several)
        )

    return with_options(run, command)


def _used(data: dict[str, Any]) -> Block:
    """Time and memory of a job."""
    on_device = f", device {data['peak_device_mb']:,.0f} MB" if data["peak_device_mb"] else ""
    seconds = "  ".join(f"{name} {value:.2f}" for name, value in data["seconds"].items())
    return [
        ("seconds", seconds),
        ("peak memory", f"{data['peak_rss_mb']:,.0f} MB{on_device}"),
        ("device", data["device"]),
    ]


def _parts(request: "Request", cache: "Cache") -> int:
    """Parts of a job; 1 of one that will fail."""
    from lgrasp.errors import LgraspError

    try:
        request.check()
        return len(request.job(cache).parts())
    except LgraspError:
        return 1


def run_job(job: "Job", how: How) -> tuple[dict[str, Any], "JobOutcome"]:
    """Run a job with progress; its report and outcome."""
    from lgrasp.engine.report import job_report
    from lgrasp.engine.run import run
    from lgrasp.files import before_end
    from lgrasp_cli.progress import Bar, JobProgress, interruptible

    with Bar(quiet=how.quiet) as bar, interruptible(JobProgress(bar, job.unit)) as progress, before_end(job.abandon):
        outcome = (how.outcome or partial(run, array=how.array, resume=not how.overwrite))(job, progress)
    outcome.stopped = progress.stop
    return job_report(outcome), outcome


def conclude(outcome: "JobOutcome", how: How) -> None:
    """Leave with the exit code of a job that fell short.

    Raises:
        LgraspError: less came out than was asked.
    """
    if outcome.cancelled:
        typer.echo(f"interrupted: {_left(outcome, how)}", err=True)
        raise typer.Exit(130)
    if error := outcome.job.shortfall(outcome):
        raise error


def _left(outcome: "JobOutcome", how: How) -> str:
    """What an interrupted job leaves, and what the same command makes of it."""
    job, done, kept = outcome.job, len(outcome.paths), outcome.job.kept_rows(outcome)
    verdicts = "verdicts of " if job.command == "simulate" else ""
    what = f"{verdicts}{plural(kept, job.unit[:-1])}{' of the next' if done else ''}"
    rows = f"{what} {'is' if kept == 1 and not verdicts else 'are'} kept" if kept else ""
    files = f"{done:,} of {plural(len(outcome.parts), 'file')} done in {job.folder}" if done else ""
    if not (done or kept):
        if not how.cache.fresh and any(map(job.has_prepared, outcome.parts)):
            return "what was prepared is kept; the same command goes on"
        return "nothing is finished; the same command begins again"
    dropped = {"--overwrite": how.overwrite and done, "--rebuild": how.cache.fresh and kept}
    without = " and ".join(name for name, drops in dropped.items() if drops)
    again = f"the same command{without and f' without {without}'}"
    return "; ".join(filter(None, (files, rows, f"{again} makes the rest")))

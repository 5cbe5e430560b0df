"""The one loop of all jobs: device, folder, existing parts, kernels, parts one after another, report."""

import os
import time
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, Self

from pydantic import Field, PrivateAttr

from lgrasp import __version__
from lgrasp.dataset.differences import is_as_listed
from lgrasp.dataset.manifest import ListedRun, ListedShard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import CancelledError, Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import Found, clean_folder, found_shard, neighbours
from lgrasp.engine.listing import Listing, Renewing, begun_array, entries
from lgrasp.engine.request import Request
from lgrasp.errors import LgraspError, OutputError, ShardError
from lgrasp.notices import notice
from lgrasp.outputs import check_folder
from lgrasp.runtime.array import Array
from lgrasp.runtime.cores import threads
from lgrasp.runtime.device import Device, resolve_device
from lgrasp.runtime.kernels import first_time, kernel_modules, load_kernels
from lgrasp.runtime.ordered import in_order
from lgrasp.words import plural


class Job(Request, ABC):
    """A job that makes files part by part: what is asked, and how one part is made.

    What is loaded for the parts is private to the job.
    """

    command: ClassVar[str]
    """Words of the command line that run the job."""
    asks: ClassVar[bool] = False
    """True if fewer rows than requested may be found. A part without any then ends the job."""
    kernels: ClassVar[tuple[str, ...]] = ("lgrasp.stages.", "lgrasp.grasp.", "lgrasp.hold.")
    """Prefixes of the modules whose kernels the parts launch; empty: none."""
    one_key: ClassVar[bool] = True
    """True if all parts have the key of the job, and so have all files of their name in the folder."""
    differs: ClassVar[str] = "other parameters"
    """What may be other in a file with another key."""
    late_key: ClassVar[bool] = False
    """True if the key is known only once what the parts are made of was made."""

    cache: Cache = Field(default_factory=Cache, exclude=True, repr=False)
    _device: Device | None = PrivateAttr(None)
    _events: Events = PrivateAttr(default_factory=Events)
    _manifests: Listing | Renewing | None = PrivateAttr(None)
    _listed: dict[Path, ListedShard] = PrivateAttr(default_factory=dict)  # by manifests
    _growing: set[int] = PrivateAttr(default_factory=set)  # numbers of parts that are there with fewer rows

    @property
    def folder(self) -> Path:
        """Where the files go."""
        return self.values()["out"]

    @abstractmethod
    def key(self) -> str:
        """Content key of all that decides the parts; stored in each of them."""

    @abstractmethod
    def parts(self) -> list[Part]:
        """Every part, numbered from 0, of all tasks of an array.

        Raises:
            LgraspError: an option is out of range, or an input is not found.
        """

    def whole(self, parts: list[Part], *, some: bool) -> list[Part]:
        """Those of some parts whose inputs can be read to their end; this may take long, and is asked of the parts of
        one task only.

        Raises:
            LgraspError: an input that was named cannot, or, if there must be ``some``, none can.
        """
        return parts

    def import_kernels(self) -> None:
        """Import the modules below ``kernels`` that the parts to be made need."""

    def warm(self) -> None:
        """Have libraries load what their first call would, once the inputs are loaded and while kernels are."""

    def about(self) -> dict[str, Any]:
        """What manifests say of the run, as far as it is the same for all parts: ``hand``, ``objects``, ``pipeline``,
        ``seed``; called when the inputs are loaded."""
        return {}

    def part_key(self, part: Part) -> str:
        """Content key that the file of a part holds."""
        return self.key()

    def present(self, parts: Sequence[Part]) -> dict[int, int]:
        """Rows of the parts that are on disk and may stay, by number.

        A file stays when it holds what is asked (or more: nothing is thrown away when fewer are asked later), or when
        all candidates that it may try were tried.

        Raises:
            OutputError: a file, or the folder's first of that name, belongs to another run.
        """
        # one of the others is enough: whoever wrote into the folder looked as well
        for path in neighbours([part.file for part in parts])[:1] if self.one_key else ():
            with suppress(ShardError, ValueError):
                self._is_own(path, found_shard(path), self.key())
        present, self._listed = {}, entries(part.file for part in parts)
        for part in parts:
            if not os.path.lexists(part.file):
                continue
            try:
                found = self.found(part)
            except (ShardError, ValueError) as error:
                self.cache.warn(f"{part.file} is damaged ({error}); rebuilding it")
                continue
            if found is None or not self._is_own(part.file, found, self.part_key(part)):
                continue
            if found.shard not in (-1, part.shard_index):
                self.cache.warn(f"{part.file} holds shard {found.shard}, not {part.shard_index}; rebuilding it")
                continue
            if found.rows >= part.rows or self.gave_up(part.rows, found):
                present[part.number] = found.rows
            else:
                self._growing.add(part.number)
                lost = f", and its verdicts ({', '.join(found.protocols)}) are lost" if found.protocols else ""
                notice(f"{part.file} has {found.rows:,} of {part.rows:,} {self.unit}: it is completed{lost}")
        return present

    def found(self, part: Part) -> Found | None:
        """What the file of a part says of itself; None: it is there, and the part is still to be made in it.

        Raises:
            ShardError: it is damaged.
        """
        as_written = is_as_listed(self._listed.get(part.file), part.file)  # 2 ms, not 56, of 10,000 rows
        if not as_written and (problems := validate_shard(part.file)):
            raise ShardError(problems[0])
        return found_shard(part.file)

    def _is_own(self, path: Path, found: Found, key: str) -> bool:
        """Whether a file is of this run. One of another that found nothing may be replaced, one with rows stays: an
        OutputError."""
        if found.key != key and found.rows:
            raise OutputError(self.refusal(path))
        return found.key == key

    def refusal(self, path: Path) -> str:
        """Why a file of another run stays."""
        how = self.difference(path)
        return f"{path} belongs to another run ({how}); choose another --out, or --overwrite to replace it"

    def difference(self, path: Path) -> str:
        """How a file of another run differs from those of this job, in a few words."""
        return self.differs

    def replaced(self, every: Sequence[Part]) -> list[Path]:
        """Files of another run that has those of this one, beyond its last part."""
        others, found = neighbours([part.file for part in every]) if self.one_key else [], []
        key = self.key() if others else ""
        for path in others:
            with suppress(ShardError, ValueError):
                found += [path] if found_shard(path).key != key else []
        return found

    def clean(self, parts: Sequence[Part]) -> None:
        """Remove leftovers of killed processes that wrote parts; files being written stay."""
        clean_folder([part.file for part in parts])

    def gave_up(self, rows: int, found: Found) -> bool:
        """Whether a part whose file has fewer than its rows stays as it is: all that it may try was tried."""
        return True

    def load(self, events: Events, missing: bool) -> None:
        """Load the inputs of the parts onto ``self.device_used``; ``missing``: there are parts to make."""

    @abstractmethod
    def make(self, part: Part, progress: PartProgress) -> Made:
        """Make one part: a pure function of the job's settings and of its number."""

    def write(self, part: Part, contents: Any) -> None:
        """Put a part on disk, whole or not at all."""
        write_shard(part.file, contents)

    @abstractmethod
    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """The results in numbers, JSON-serialisable; :func:`lgrasp.engine.report.job_report` adds the rest."""

    def kept_rows(self, outcome: JobOutcome) -> int:
        """Rows of parts that are not done that the same job need not make again."""
        there = set(outcome.paths)
        missing = [part for part in outcome.parts if part.file not in there]
        return sum(self.kept_of(part) for part in missing[: outcome.lanes * self.at_once()])

    def kept_of(self, part: Part) -> int:
        """The same of one part."""
        return 0

    def has_prepared(self, part: Part) -> bool:
        """Whether something else is kept of what is made before the rows of a part."""
        return False

    def shortfall(self, outcome: JobOutcome) -> LgraspError | None:
        """The error for an outcome that falls short of the request, if any."""
        return None

    def at_once(self) -> int:
        """Parts that are made at a time; the first alone where rows may be missing."""
        return 1

    def writers(self) -> int:
        """Parts that are written at a time."""
        return 1

    def changed(self, **changes: Any) -> Self:
        """A copy with other fields; nothing is loaded in it."""
        return type(self)(**self.values() | changes)

    def begin(self) -> None:
        """Start what helps this process make parts, before their inputs are loaded; called if there are any to make."""

    def close(self) -> None:
        """Release what was opened for the parts; called however the job ends."""

    def abandon(self) -> None:
        """Tidy the folder; for a process that ends before :func:`run` does."""
        if self._manifests:
            self._manifests.close()

    @property
    def events(self) -> Events:
        """The listener, for inputs loaded on first use."""
        return self._events

    @property
    def device_used(self) -> Device:
        """The device, once the job has started; before that, where its parts are asked for, the CPU."""
        return self._device or resolve_device("cpu")

    def threads(self) -> int:
        """Workers as asked, else one per core, or one on a GPU."""
        return threads(self.workers or int(self.device_used.is_cuda))


def run(
    job: Job, events: Events | None = None, *, array: Array | tuple[int, int] = (0, 1), resume: bool = True
) -> JobOutcome:
    """Make the missing parts of a job.

    Args:
        array: how tasks share the parts: (task, number of tasks), or more.
        resume: keep whole parts of the same run.

    Raises:
        LgraspError: bad input, unwritable output, or files of another run in the output folder.
    """
    job._events = events = events or Events()
    start = time.perf_counter()
    array, device, every, parts, present = todo = look(job, array=array, resume=resume)
    absent = [part for part in parts if not os.path.lexists(part.file)]
    job.clean(parts)
    with closing(job):
        if len(present) < len(parts):
            job.begin()
        outcome = JobOutcome(job, device, parts, present, seconds={"kernels": prepare(job, todo)})
        if resume and absent:  # another run may have made files in the meantime
            job.present(absent)
        events.started(parts, present)
        begin = time.perf_counter()
        try:
            manifests = Renewing(parts)
            if not job.in_place:
                manifests = Listing(lambda: _described(job, array), job.folder, every, parts, asks=job.asks)
            with manifests.kept(present) as job._manifests:
                _make_parts(job, events, outcome, job._manifests, replaces=[] if resume else every)
        except CancelledError:
            outcome.cancelled = True
        finally:
            job._manifests = None  # they know each other, and Python looks for circles seldom
    outcome.seconds["parts"] = time.perf_counter() - begin
    outcome.seconds["total"] = time.perf_counter() - start
    return outcome


def prepare(job: Job, todo: "Todo") -> float:
    """Load the inputs and kernels of a job that :func:`look` saw; seconds that the kernels took."""
    missing = [part for part in todo.parts if part.number not in todo.present]
    begin = time.perf_counter()
    if missing and job.kernels:
        job.import_kernels()
        modules = kernel_modules(*job.kernels)
        if words := first_time(todo.device.alias, modules):
            job.events.said(words)
            load_kernels(todo.device.alias, modules, job.events.loading, preparing=True)
    kernels = time.perf_counter() - begin
    job.load(job.events, bool(missing))
    begin = time.perf_counter()
    if missing and job.kernels:
        with ThreadPoolExecutor(1) as pool:
            warmed = pool.submit(job.warm)
            load_kernels(todo.device.alias, kernel_modules(*job.kernels), job.events.loading)
            warmed.result()
    return kernels + time.perf_counter() - begin


def _described(job: Job, array: Array) -> ListedRun:
    told: dict[str, Any] = {"job": job.command, "unit": job.unit, "lgrasp_version": __version__}
    return ListedRun(run_key=job.key(), array=array.text or None, **told, **job.about())


class Todo(NamedTuple):
    """What a job has before it."""

    array: Array
    device: Device
    every: list[Part]
    parts: list[Part]
    """Those of this task."""
    present: dict[int, int]
    """Rows of those that are there, by number."""


def look(job: Job, *, array: Array | tuple[int, int], resume: bool) -> Todo:
    """What a job has before it; nothing is written.

    Raises:
        LgraspError: as :func:`run`, before anything is loaded.
    """
    job.check()
    job._device = resolve_device(job.device)
    array, every, parts = own_parts(job, array if isinstance(array, Array) else Array(*array))
    if array.tasks > 1:
        job.events.said(array.words([part.number for part in parts], job.part))
    check_folder(job.folder)
    whole = job.whole(parts, some=array.lanes == 1)
    lost = set(parts) - set(whole)
    every = [part for part in every if part not in lost]
    return Todo(array, job.device_used, every, whole, job.present(whole) if resume else {})


def own_parts(job: Job, array: Array) -> tuple[Array, list[Part], list[Part]]:
    """The array with its numbers, all parts of a job, and those of the task.

    Raises:
        LgraspError: an option is out of range, or an input is not found; SLURM started more tasks than there are parts.
    """
    every = job.parts()
    array = array.resolved(begun_array(every) if array.slurm and not job.in_place else "")
    return array, every, array.share(every, job.part)


def _make_parts(
    job: Job, events: Events, outcome: JobOutcome, manifests: Listing | Renewing, *, replaces: Sequence[Part]
) -> None:
    """Make what is missing, in order; parts are written, on other threads, while the next are made.

    CancelledError comes when whole parts are written, those made beside an unfinished one, too. Once the first of
    ``replaces``, all parts of a job that replaces files, is whole, what else is there of the run before goes.
    """
    writing: deque[tuple[Part, Made, Future[None]]] = deque()

    def settle(most: int = 0) -> None:
        """Until at most so many are being written."""
        while len(writing) > most:
            part, made, future = writing.popleft()
            future.result()
            outcome.made_parts.append((part, made))
            events.wrote(part, made)
            made.contents = None  # memory must not grow with the parts
            if part.number == 0 and isinstance(manifests, Listing) and (left := job.replaced(replaces)):
                manifests.remove(left)
                notice(f"{plural(len(left), 'more shard')} of the run before removed, first {left[0]}")

    def write(part: Part, made: Made) -> None:
        job.write(part, made.contents)
        manifests.record(part, made.rows, written=True)

    def make(part: Part) -> Made | CancelledError | None:
        if part.number in present:
            return None
        progress = PartProgress(events, part)
        try:
            progress.check()
            return job.make(part, progress)
        except CancelledError as error:
            return error

    def made_in_order() -> Iterator[tuple[Part, Made | CancelledError | None]]:
        parts = (part for part in outcome.parts if not stopped)
        for part in parts if job.asks else ():
            yield part, make(part)
            if part.number not in present:
                break  # what the first finds, the others go by
        yield from in_order(make, parts, job.at_once())

    present, stopped = outcome.on_disk, None
    with ThreadPoolExecutor(job.writers()) as writer:
        for part, made in made_in_order():
            if isinstance(made, CancelledError):
                stopped = made
                continue
            rows = present[part.number] if made is None else made.rows
            if stopped and rows < part.rows:  # what becomes of such a part depends on those before it
                continue
            outcome.starved |= job.asks and rows < part.rows
            if made is not None:
                outcome.results.append(made.result)
                if made.contents is not None:
                    settle(job.writers() - 1)
                    writing.append((part, made, writer.submit(write, part, made)))
                else:
                    manifests.record(part, 0, written=False)
            if job.asks and rows == 0:  # the next parts would hardly give any either
                for other in outcome.parts[outcome.parts.index(part) + 1 :]:
                    if other.number not in present:
                        manifests.record(other, 0, written=False)
                break
        settle()
    if stopped:
        raise stopped

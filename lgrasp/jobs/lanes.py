"""Jobs of any kind on several devices side by side: a process for each, its lane, makes a share of their files."""

import time
from collections import defaultdict
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from typing import Any, NamedTuple

from lgrasp.dataset.manifest import TEMPORARY
from lgrasp.engine.cache import Cache
from lgrasp.engine.events import Events, JobOutcome, Made, Part
from lgrasp.engine.request import Request
from lgrasp.engine.run import Job, look, own_parts, prepare, run
from lgrasp.errors import DeviceError, LgraspError
from lgrasp.files import remove_leftovers
from lgrasp.runtime.array import Array
from lgrasp.runtime.device import Device, resolve_device
from lgrasp.runtime.processes import Crew, Link

_OFTEN = 0.2  # [s] between two messages on how far a part is


class Lanes(ExitStack):
    """Lanes for some jobs, which they begin with the first :meth:`outcome`; they end with the block.

    The files, and their contents, are those of one device: a lane is a task of an array in this respect.

    Args:
        devices: one lane each.
        arrays: of each job the task that the lanes share.
        resume: keep whole parts of the same run.
    """

    def __init__(
        self, devices: Sequence[Device], jobs: Sequence[Request], arrays: Sequence[Array], cache: Cache, *, resume: bool
    ) -> None:
        super().__init__()
        self._devices, self._jobs, self._arrays, self._cache, self._resume = devices, jobs, arrays, cache, resume
        self._ends: dict[int, dict[int, JobOutcome | Exception]] = defaultdict(dict)  # of each job, those of lanes
        self._lost: dict[int, DeviceError] = {}  # lanes that were killed
        self._told: dict[int, dict[int, _Far]] = defaultdict(dict)  # of each job, the latest of each part
        self._crew: Crew | None = None

    def outcome(self, number: int, job: Job, events: Events) -> JobOutcome:
        """What all lanes made of the job of some number, which is ``job``; it is loaded then, for its report.

        Raises:
            LgraspError: as of :func:`lgrasp.engine.run.run`; the first of any lane.
        """
        begin = time.perf_counter()
        job._events = events
        todo = look(job, array=self._arrays[number], resume=False)  # lanes look for files that are there
        outcome = JobOutcome(job, todo.device, todo.parts, {}, lanes=len(self._devices))
        first = self._crew is None
        crew = self._crew
        if crew is None:  # inputs and kernels are made once, not by all lanes at a time
            there = [part for part in todo.parts if self._resume and part.file.exists()]
            job.present(there[:1])  # another run's folder is refused at once
            outcome.seconds["kernels"] = prepare(job, todo._replace(present={part.number: 0 for part in there}))
            crew = self._crew = self.enter_context(self._started(number))
        events.started(todo.parts, {})
        making = time.perf_counter()
        try:
            self._wait(crew, number, events)
            if not first:
                job.load(events, False)
        except DeviceError:  # of a lane that was killed; the next job starts them again
            self.close()
            self._crew = None
            for of_lanes in (self._ends, self._told, self._lost):
                of_lanes.clear()
            job.clean(todo.parts)
            for folder in {job.folder, *(part.file.parent for part in todo.parts)}:
                remove_leftovers(folder, TEMPORARY)
            raise
        finally:
            job.close()
        outcome.cancelled = len(self._ends[number]) < len(self._devices)  # lanes that were stopped before they began
        names = list(dict.fromkeys(device.name for device in self._devices))
        outcome.device = replace(todo.device, name=f"{len(self._devices)} x {', '.join(names)}")
        for end in self._ends[number].values():
            if isinstance(end, Exception):
                raise end
            outcome.on_disk |= end.on_disk
            outcome.made_parts += end.made_parts
            outcome.results += end.results
            outcome.starved |= end.starved
            outcome.cancelled |= end.cancelled
        outcome.made_parts.sort(key=lambda made: made[0].number)
        end = time.perf_counter()
        outcome.seconds = {"kernels": 0.0} | outcome.seconds | {"parts": end - making, "total": end - begin}
        return outcome

    def _started(self, first: int) -> Crew:
        """Lanes for the jobs from one on."""
        jobs = [(type(job), {k: v for k, v in job.values().items() if k != "cache"}) for job in self._jobs]
        shared = jobs, first, self._arrays, self._cache.root, self._resume
        count = len(self._devices)
        tasks = [(device.alias, lane, count, *shared) for lane, device in enumerate(self._devices)]
        return Crew(_make_share, tasks, [f"{d.alias} (lane {n} of {count})" for n, d in enumerate(self._devices, 1)])

    def _wait(self, crew: Crew, number: int, events: Events) -> None:
        """Until all lanes are done with a job, one failed, or all have ended.

        Raises:
            DeviceError: one was killed before it was done.
        """
        for far in self._told.pop(number, {}).values():
            far.tell(events)
        ends = self._ends[number]
        while True:
            if killed := self._lost.keys() - ends.keys():
                raise self._lost[min(killed)]
            failed = any(isinstance(end, Exception) for end in ends.values())
            if failed or len(ends) == len(self._devices) or not crew.working:
                return
            for lane, said in crew.heard(0.1):
                if isinstance(said, DeviceError):
                    self._lost[lane] = said
                    continue
                at, message = said
                if isinstance(message, _Far):
                    if at == number:
                        message.tell(events)
                    self._told[at][message.part.number] = message
                elif isinstance(message, str):
                    self._cache.warn(message)
                else:
                    self._ends[at][lane] = message
            if events.cancelled():
                crew.stop()


class _Far(NamedTuple):
    """How far a part is, see :meth:`Events.advanced`; ``rows``: it is on disk, with so many."""

    part: Part
    done: int
    note: str = ""
    ahead: float = 0.0
    kept: int = 0
    rows: int | None = None

    def tell(self, events: Events) -> None:
        if self.rows is None:
            events.advanced(self.part, self.done, self.note, self.ahead, self.kept)
        else:
            events.wrote(self.part, Made(self.rows))


class _Telling(Events):
    """Tells the process that shows progress, in a lane."""

    def __init__(self, link: Link, number: int) -> None:
        self._link, self._number, self._last = link, number, 0.0

    def started(self, parts: Sequence[Part], present: Mapping[int, int]) -> None:
        for part in (part for part in parts if part.number in present):
            rows = present[part.number]
            self._link.send((self._number, _Far(part, rows, kept=rows)))

    def advanced(self, part: Part, done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        if time.monotonic() - self._last > _OFTEN:
            self._last = time.monotonic()
            self._link.send((self._number, _Far(part, done, note, ahead, kept)))

    def wrote(self, part: Part, made: Made) -> None:
        self._link.send((self._number, _Far(part, made.rows, rows=made.rows)))

    def cancelled(self) -> bool:
        return self._link.stopped()


def _make_share(
    link: Link,
    device: str,
    lane: int,
    lanes: int,
    jobs: Sequence[tuple[type[Request], dict[str, Any]]],
    first: int,
    arrays: Sequence[Array],
    root: Any,
    resume: bool,
) -> None:
    """The work of a lane: its parts of all jobs from the first on, one after another."""
    cache = Cache(root)
    for number in range(first, len(jobs)):
        (kind, values), array = jobs[number], arrays[number]
        if link.stopped():
            return
        cache.warn = lambda line, number=number: link.send((number, line))
        cache.more_jobs = number + 1 < len(jobs)
        try:
            array = array._replace(lane=lane, lanes=lanes)
            found = _run(kind, values | {"device": device}, cache, array, resume, _Telling(link, number))
        except (LgraspError, MemoryError, OSError) as error:
            link.send((number, type(error)(str(error)) if isinstance(error, LgraspError) else error))
        except Exception as error:
            link.send((number, RuntimeError(f"{type(error).__name__} on {device}: {error}")))
        else:
            found.job = None  # stays here
            link.send((number, found))


def _run(
    kind: type[Request], values: dict[str, Any], cache: Cache, array: Array, resume: bool, events: Events
) -> JobOutcome:
    job = kind(**values, cache=cache) if issubclass(kind, Job) else kind(**values).job(cache)
    if not own_parts(job, array)[-1]:
        return JobOutcome(None, resolve_device(values["device"]), [], {})
    return run(job, events, array=array, resume=resume)

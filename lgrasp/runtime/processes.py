"""Processes that work side by side for the one that started them, and end with it."""

import multiprocessing
import os
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from importlib import import_module
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnContext, SpawnProcess
from types import ModuleType, TracebackType
from typing import Any, Self, TypeVar, cast

from lgrasp.errors import DeviceError
from lgrasp.files import discard_temporaries
from lgrasp.signals import spared

T = TypeVar("T")

_starting = threading.Lock()
_PATIENCE = 4.0  # [s] that a process may take to end when it is asked to


class Link:
    """To the process that started this one; may be used by several threads."""

    def __init__(self, connection: Connection) -> None:
        self._connection, self._lock = connection, threading.Lock()

    def send(self, message: Any) -> None:
        """Send anything that can be pickled."""
        with self._lock:
            self._connection.send(message)

    def stopped(self) -> bool:
        """True once this process is to end."""
        return self._connection.poll()


class Crew:
    """A process for each of several tasks, while the block runs: ``work(link, *task)``.

    They are spared the signals that ask to stop: this process gets them, and calls :meth:`stop`.

    Args:
        work: a function of a module.
        tasks: its further arguments, which can be pickled.
        names: of the tasks, for messages.
    """

    def __init__(self, work: Callable[..., None], tasks: Sequence[tuple[Any, ...]], names: Sequence[str]) -> None:
        self._names, self._ended = names, set()
        self._links: list[Connection] = []
        self._waiting: list[Connection] = []  # not asked to end yet
        self._processes: list[Any] = []
        context = multiprocessing.get_context("spawn")
        start_tracker()
        with spared():
            for task in tasks:
                own, theirs = context.Pipe()
                process = context.Process(target=_work, args=(theirs, work, task), daemon=False)
                process.start()
                theirs.close()
                self._links.append(own)
                self._processes.append(process)
        self._waiting = list(self._links)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self.stop()
        for process in self._processes:
            process.join(_PATIENCE)
            if process.is_alive():
                process.kill()
                process.join()

    @property
    def working(self) -> bool:
        """True until all processes have returned."""
        return len(self._ended) < len(self._links)

    def stop(self) -> None:
        """Ask all processes to end."""
        links, self._waiting = self._waiting, []
        for link in links:
            with suppress(OSError):  # it has ended
                link.send(None)

    def heard(self, seconds: float) -> list[tuple[int, Any]]:
        """What processes sent, with their numbers, once there is something or the time is over; a DeviceError, the
        last of one that ended otherwise than by returning."""
        links = {link: number for number, link in enumerate(self._links) if number not in self._ended}
        found = []
        for link in wait(list(links), seconds) if links else ():
            number = links[cast(Connection, link)]
            try:
                found.append((number, self._links[number].recv()))
            except (EOFError, OSError):
                self._ended.add(number)
                self._processes[number].join()
                if code := self._processes[number].exitcode:
                    how = f"by signal {-code}" if code < 0 else f"with exit code {code}"
                    name = self._names[number]
                    found.append((number, DeviceError(f"the process on {name} ended {how}; the same command goes on")))
        return found


class _SparedProcess(SpawnProcess):
    """One that does not get the signal by which an executor ends the others where one was killed."""

    def terminate(self) -> None:
        self.kill()


class _SparingContext(SpawnContext):
    Process = _SparedProcess


class ProcessPool(ProcessPoolExecutor):
    """Processes for calls of functions of modules, while the block runs.

    They are spared the signals that ask to stop, and end with the process that started them.
    """

    def __init__(self, workers: int) -> None:
        start_tracker()
        self._workers, self._watched = workers, set[int]()
        self._ending = threading.Lock()  # taken for good by what ends the pool
        super().__init__(workers, _SparingContext(), follow_parent)

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        with spared(), _no_main():  # it starts processes
            future = super().submit(fn, *args, **kwargs)
            processes: Any = self._processes or {}
            for number in processes.keys() - self._watched:
                self._watched.add(number)
                what = processes[number], processes, self._result_queue, self._ending
                threading.Thread(target=_end_with, args=what, daemon=True).start()
            return future

    def start(self, module: str) -> None:
        """Have every process start, and load what a module needs, before there is work."""
        for _ in range(self._workers):
            self.submit(import_module, module)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """As every executor's; with ``cancel_futures`` calls that have begun are cut off."""
        self._ending.acquire(blocking=False)
        manager: Any = self._executor_manager_thread
        processes = list((self._processes or {}).values())
        super().shutdown(wait=False, cancel_futures=cancel_futures)
        for process in processes if cancel_futures else ():
            process.kill()
        if wait and manager:
            manager.join(_PATIENCE if cancel_futures else None)

    def __exit__(
        self, exc_type: type[BaseException] | None, exc_val: BaseException | None, exc_tb: TracebackType | None
    ) -> None:
        self.shutdown(cancel_futures=exc_type is not None)


def _end_with(process: Any, processes: dict[int, Any], results: Any, once: threading.Lock) -> None:
    """End a pool of which a process was killed. That may have left half a result in the pipe that all of them write to,
    and the executor would wait for the other half for good."""
    wait([process.sentinel])
    if once.acquire(blocking=False):
        for other in list(processes.values()):
            other.kill()
        results._writer.close()


@contextmanager
def none_killed(what: str) -> Iterator[None]:
    """Calls to a :class:`ProcessPool` and their results, inside the block.

    Args:
        what: the processes do, such as ``simulates``.

    Raises:
        DeviceError: one of them was killed.
    """
    try:
        yield
    except BrokenProcessPool:
        raise DeviceError(f"a process that {what} was killed; the same command goes on") from None


@contextmanager
def _no_main() -> Iterator[None]:
    """Processes that are started inside the block do not run the program's main file again, which scripts without
    ``if __name__ == "__main__"`` would not survive."""
    with _starting:
        main = sys.modules["__main__"]
        sys.modules["__main__"] = ModuleType("__main__")
        try:
            yield
        finally:
            sys.modules["__main__"] = main


def _work(connection: Connection, work: Callable[..., None], task: tuple[Any, ...]) -> None:
    follow_parent()
    work(Link(connection), *task)


def follow_parent() -> None:
    """In a process that was started: end when the one that started it has ended in any way."""
    parent = multiprocessing.parent_process()

    def follow() -> None:
        assert parent is not None
        parent.join()
        discard_temporaries()
        os._exit(1)

    if parent is not None:
        try:
            threading.Thread(target=follow, daemon=True).start()
        except RuntimeError:  # no more threads are allowed: the one that started this says so
            os._exit(1)


def start_tracker() -> None:
    """Start the process that removes the semaphores of others that were killed, before these: it would print a warning
    then, and while it starts signals come through."""
    before = os.environ.get("PYTHONWARNINGS", "")
    os.environ["PYTHONWARNINGS"] = f"{before},ignore:resource_tracker".lstrip(",")
    try:
        with spared():
            resource_tracker.ensure_running()
    finally:
        os.environ["PYTHONWARNINGS"] = before

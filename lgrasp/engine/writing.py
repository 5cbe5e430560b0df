"""Writes one shard while the next is made."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Generic, TypeVar

from lgrasp.dataset import Shard, write_shard
from lgrasp.engine.shard import Found

Result = TypeVar("Result", bound=Found)


class BackgroundWriter(Generic[Result]):
    """A context that writes shards on another thread, one at a time and in order.

    Args:
        written: called on the caller's thread with (shard, result) when a shard is on disk.
    """

    def __init__(self, written: Callable[[int, Result], None]) -> None:
        self._written = written
        self._pool = ThreadPoolExecutor(1)
        self._pending: tuple[int, Result, Future[None]] | None = None

    def put(self, shard: int, path: Path, contents: Shard, result: Result) -> None:
        """Wait for the shard before, then begin to write this one.

        Raises:
            OutputError, ShardError: the shard before could not be written.
        """
        self.settle()
        self._pending = (shard, result, self._pool.submit(write_shard, path, contents))

    def settle(self) -> None:
        """Wait until nothing is being written.

        Raises:
            OutputError, ShardError: the last shard could not be written.
        """
        if self._pending is not None:
            shard, result, future = self._pending
            self._pending = None
            future.result()
            self._written(shard, result)

    def __enter__(self) -> "BackgroundWriter[Result]":
        return self

    def __exit__(self, kind: type[BaseException] | None, _: BaseException | None, __: TracebackType | None) -> None:
        try:
            if kind is None:
                self.settle()
        finally:
            self._pool.shutdown(wait=True)

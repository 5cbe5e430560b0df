"""Verdicts on the rows of a shard so far, kept in the cache: a killed simulation loses the last block of rows."""

import time

import numpy as np

from lgrasp.engine.cache import Cache

GPU_BLOCK = 8192
"""Rows of a block on a GPU, which simulates so many side by side."""

_BLOCK_SECONDS = 15.0  # that a block of rows should take
_FIRST = 8  # rows of the first block, for each thread
_KIND = "verdicts"  # of the entries
_NUMBERS = "about"  # member with the seconds


class KeptVerdicts:
    """Columns of the first ``rows`` rows of a shard, with the seconds that they took in all runs.

    Args:
        key: content key of the rows and of all that decides their verdicts.
        protocol: its name, with which the columns begin.
        largest: rows of every block; None: as many as take some seconds.
    """

    def __init__(self, cache: Cache, key: str, protocol: str, *, largest: int | None = None) -> None:
        self._cache, self._key, self._protocol, self._largest = cache, key, protocol, largest
        self.columns: dict[str, np.ndarray] = cache.load(_KIND, key) or {}
        self.seconds, self.compiling = map(float, self.columns.pop(_NUMBERS, (0.0, 0.0)))
        self._begin, self._prepared = time.perf_counter(), 0.0

    @property
    def rows(self) -> int:
        """Rows that have a verdict."""
        return len(self.columns[f"{self._protocol}_holds"]) if self.columns else 0

    @property
    def held(self) -> int:
        """Rows that hold."""
        return int(self.columns[f"{self._protocol}_holds"].sum()) if self.columns else 0

    @property
    def seconds_now(self) -> float:
        """Seconds of simulation, those of the running block included."""
        return self.seconds + time.perf_counter() - self._begin - self._prepared

    def prepared(self, seconds: float) -> None:
        """Take note of seconds in which models were made."""
        self._prepared += seconds

    def next_block(self, rows: int, threads: int) -> int:
        """Rows to simulate next, of so many in all."""
        rate = self.rows / self.seconds if self.seconds else 0.0
        size = self._largest or max(int(rate * _BLOCK_SECONDS), _FIRST * threads)
        self._begin, self._prepared = time.perf_counter(), 0.0
        return min(size, rows - self.rows)

    def add(self, found: dict[str, np.ndarray], *, last: bool) -> None:
        """Add the columns of a block and keep all, unless it is the last."""
        self.seconds, self.compiling = self.seconds_now, self.compiling + self._prepared
        before = self.columns or {name: values[:0] for name, values in found.items()}
        self.columns = {name: np.concatenate([before[name], values]) for name, values in found.items()}
        if not last:
            self._cache.store(_KIND, self._key, self.columns | {_NUMBERS: np.array([self.seconds, self.compiling])})

    def discard(self) -> None:
        """Forget what was kept: the shard has its verdicts."""
        self._cache.discard(_KIND, self._key)

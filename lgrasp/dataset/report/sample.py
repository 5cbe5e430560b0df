"""A bounded, even sample of a stream of rows."""

import numpy as np


class EvenSample:
    """Every k-th row of a stream, however it is cut; k doubles whenever more than ``limit`` rows are held.

    Args:
        limit: Most rows held.
    """

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.step = 1
        """Every how many-th row is held."""
        self._seen = 0
        self._parts: list[dict[str, np.ndarray]] = []

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Take rows: arrays with one first axis, the same names at every call."""
        n = len(next(iter(columns.values())))
        first = -self._seen % self.step
        self._seen += n
        if first < n:
            self._parts.append({name: values[first :: self.step] for name, values in columns.items()})
        while self._count() > self.limit:
            held = self.columns()
            self._parts = [{name: values[::2] for name, values in held.items()}]
            self.step *= 2

    def _count(self) -> int:
        return sum(len(next(iter(part.values()))) for part in self._parts)

    def columns(self) -> dict[str, np.ndarray]:
        """The rows held; empty if there were none."""
        if not self._parts:
            return {}
        return {name: np.concatenate([part[name] for part in self._parts]) for name in self._parts[0]}

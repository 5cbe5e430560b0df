"""Survivors and seconds of stages, counted on their device and read when somebody asks."""

import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from enum import EnumType, IntEnum

import numpy as np
import warp as wp

from lgrasp.runtime.fetch import fetch


class Tally(Mapping[str, int]):
    """Counts by name; the first look waits for the device."""

    def __init__(self, names: Sequence[str], device: wp.array) -> None:
        self.names = tuple(names)
        self.device = device  # (names,) i32
        self._read: np.ndarray | None = None

    @property
    def known(self) -> bool:
        """True if the counts were read."""
        return self._read is not None

    def __getitem__(self, name: str) -> int:
        if not self.known:
            read_tallies([self])
        assert self._read is not None
        return int(self._read[self.names.index(name)])

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def empty_tally(names: Sequence[str] | type[IntEnum], device: str) -> Tally:
    """A tally of zeros; an enumeration counts its members, named in lower case."""
    if isinstance(names, EnumType):
        names = [name.lower() for name in names.__members__]
    return Tally(names, wp.zeros(len(names), dtype=wp.int32, device=device))


def read_tallies(
    tallies: Sequence[Tally], arrays: Sequence[wp.array] = (), *, others: bool = False
) -> list[np.ndarray]:
    """Read several tallies, and copies of other arrays, of one device with one wait (:func:`fetch`).

    Returns:
        The other arrays.
    """
    fetched = fetch([*(t.device for t in tallies), *arrays], others=others)
    for tally, values in zip(tallies, fetched, strict=False):
        tally._read = values
    return fetched[len(tallies) :]


_Moment = wp.Event | float


class Meter:
    """Stages of one batch: their counts, and how long they took on their device."""

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._parts: list[tuple[str, Mapping[str, int], _Moment, _Moment]] = []

    def now(self) -> _Moment:
        """A moment: on a GPU an event in its stream, else seconds."""
        if not self._device.is_cuda:
            return time.perf_counter()
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    def add(self, stage: str, counts: Mapping[str, int], start: _Moment, end: _Moment) -> None:
        """A stage has been run from ``start`` to ``end``."""
        self._parts.append((stage, counts, start, end))

    def again(self, arrays: Sequence[wp.array]) -> tuple["Meter", list[np.ndarray]]:
        """The same stages once more, recorded and replayed; and copies of other arrays.

        All is read at once: the next replay overwrites it. Others may launch meanwhile.
        """
        own = [Tally(c.names, c.device) if isinstance(c, Tally) else c for _, c, _, _ in self._parts]
        read = read_tallies([counts for counts in own if isinstance(counts, Tally)], arrays, others=True)
        meter = Meter(self._device.alias)
        for (stage, _, start, end), counts in zip(self._parts, own, strict=True):
            meter.add(stage, counts, 0.0, _seconds(start, end))
        return meter, read

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Survivors per stage, passes added up."""
        read_tallies([c for _, c, _, _ in self._parts if isinstance(c, Tally) and not c.known])
        total: dict[str, dict[str, int]] = {}
        for stage, counts, _, _ in self._parts:
            add_counts(total, {stage: counts})
        return total

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage, passes added up."""
        total: dict[str, float] = {}
        for stage, _, start, end in self._parts:
            total[stage] = total.get(stage, 0.0) + _seconds(start, end)
        return total


def _seconds(start: _Moment, end: _Moment) -> float:
    """Between two moments; waits for the second."""
    if isinstance(start, float) and isinstance(end, float):
        return end - start
    return wp.get_event_elapsed_time(start, end) / 1000.0


def add_counts(total: dict[str, dict[str, int]], more: Mapping[str, Mapping[str, int]]) -> None:
    """Add survivors per stage to a running total."""
    for stage, counts in more.items():
        into = total.setdefault(stage, {})
        for name, value in counts.items():
            into[name] = into.get(name, 0) + value


def add_seconds(total: dict[str, float], more: Mapping[str, float]) -> None:
    """Add seconds per stage to a running total."""
    for stage, value in more.items():
        total[stage] = total.get(stage, 0.0) + value


def covered(spans: Iterable[tuple[float, float]]) -> float:
    """Seconds in one span of time, (begin, end), at least."""
    total, until = 0.0, float("-inf")
    for begin, end in sorted(spans):
        total += max(end - max(begin, until), 0.0)
        until = max(until, end)
    return total

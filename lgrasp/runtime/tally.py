"""Survivors and seconds of stages, counted on their device and read when somebody asks."""

import time
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum

import numpy as np
import warp as wp

from lgrasp.runtime.fetch import fetch


class Tally(Mapping[str, int]):
    """Counts by name; the first look waits for the device."""

    def __init__(self, names: Sequence[str], device: wp.array) -> None:
        self.names = tuple(names)
        self.device = device  # (names,) i32
        self._read: np.ndarray | None = None

    def __getitem__(self, name: str) -> int:
        if self._read is None:
            read_tallies([self])
        assert self._read is not None
        return int(self._read[self.names.index(name)])

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def empty_tally(names: Sequence[str] | type[IntEnum], device: str) -> Tally:
    """A tally of zeros; an enumeration counts its members, named in lower case."""
    if isinstance(names, type):
        names = [member.name.lower() for member in names]
    return Tally(names, wp.zeros(len(names), dtype=wp.int32, device=device))


def read_tallies(tallies: Sequence[Tally], arrays: Sequence[wp.array] = ()) -> list[np.ndarray]:
    """Read several tallies, and copies of other arrays, of one device with one wait.

    Returns:
        The other arrays.
    """
    fetched = fetch([*(t.device for t in tallies), *arrays])
    for tally, values in zip(tallies, fetched, strict=False):
        tally._read = values
    return fetched[len(tallies) :]


_Moment = wp.Event | float


class Meter:
    """Stages of one batch: their counts, and how long they took on their device."""

    def __init__(self, device: str) -> None:
        self._device = wp.get_device(device)
        self._parts: list[tuple[str, Mapping[str, int], _Moment | None, _Moment | None]] = []

    def now(self) -> _Moment:
        """A moment: on a GPU an event in its stream, else seconds."""
        if not self._device.is_cuda:
            return time.perf_counter()
        return self._device.stream.record_event(wp.Event(self._device, enable_timing=True))

    def add(
        self, stage: str, counts: Mapping[str, int], start: _Moment | None = None, end: _Moment | None = None
    ) -> None:
        """A stage has been run from ``start`` to ``end``, or its table was read from the bank."""
        self._parts.append((stage, counts, start, end))

    def again(self) -> "Meter":
        """The same stages once more, recorded and replayed: their counts have not been read."""
        meter = Meter(self._device.alias)
        for stage, counts, start, end in self._parts:
            meter.add(stage, Tally(counts.names, counts.device) if isinstance(counts, Tally) else counts, start, end)
        return meter

    @property
    def counts(self) -> dict[str, dict[str, int]]:
        """Survivors per stage, passes added up."""
        read_tallies([counts for _, counts, _, _ in self._parts if isinstance(counts, Tally)])
        total: dict[str, dict[str, int]] = {}
        for stage, counts, _, _ in self._parts:
            add_counts(total, {stage: counts})
        return total

    @property
    def seconds(self) -> dict[str, float]:
        """Seconds per stage, passes added up."""
        total: dict[str, float] = {}
        for stage, _, start, end in self._parts:
            if start is None or end is None:
                continue
            if isinstance(start, float) and isinstance(end, float):
                elapsed = end - start
            else:
                elapsed = wp.get_event_elapsed_time(start, end) / 1000.0
            total[stage] = total.get(stage, 0.0) + elapsed
        return total


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

"""Counts and seconds per stage of a batch, without waiting for the device between stages."""

import time
from collections.abc import Mapping

import warp as wp

from lgrasp.runtime.tally import Tally, read_tallies

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
            into = total.setdefault(stage, {})
            for name, value in counts.items():
                into[name] = into.get(name, 0) + value
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

"""Survivors of a stage, counted on its device and read when somebody asks."""

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

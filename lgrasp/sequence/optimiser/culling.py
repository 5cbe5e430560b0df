"""Which entries of a mask continue: exactly those, or up to a fixed number where work is recorded once and replayed."""

from typing import NamedTuple

import torch

_ROOM_FACTOR = 1.5
"""Room that is made beyond what was needed, when there was too little."""


class Kept(NamedTuple):
    """Entries that continue."""

    index: torch.Tensor
    """Places in the mask, (E,) int64; unused ones are any, spread out: whoever adds up adds zeros there."""
    used: torch.Tensor | None
    """Which entries are in use, (E,) bool; None: all."""

    def allowed(self, mask: torch.Tensor) -> torch.Tensor:
        """A mask (E,) or (E, n) of these entries with the unused ones taken out."""
        if self.used is None:
            return mask
        return mask & (self.used if mask.dim() == 1 else self.used[:, None])


class Culling:
    """Stages of culling; results are the same in both modes as long as there is room.

    Freely, shapes depend on the data and a GPU is waited for. Fixed, every stage has room for a number of entries, and
    :meth:`lacking` tells afterwards whether that was enough.

    Args:
        rooms: entries per row that each stage begins with in fixed mode.
    """

    def __init__(self, rooms: tuple[float, ...], device: str | torch.device) -> None:
        self._per_row = list(rooms)
        self._sizes: list[int] | None = None
        self._most = torch.zeros(len(rooms), dtype=torch.int64, device=device)

    def fix(self, rows: int) -> None:
        """Room for ``rows`` rows from now on."""
        self._sizes = [max(1, round(room * rows)) for room in self._per_row]
        self._most.zero_()

    def free(self) -> None:
        """Shapes as the data has them from now on."""
        self._sizes = None

    def lacking(self, rows: int) -> bool:
        """True if there was too little room since :meth:`fix`; it is then enlarged, and the results are void."""
        assert self._sizes is not None
        most = self._most.tolist()
        short = [k for k, (size, need) in enumerate(zip(self._sizes, most, strict=True)) if need > size]
        for k in short:
            self._per_row[k] = _ROOM_FACTOR * most[k] / rows
        if short:
            self.fix(rows)
        return bool(short)

    def keep(self, stage: int, mask: torch.Tensor) -> Kept:
        """Entries at which a mask (n,) is true, in order."""
        if self._sizes is None:
            return Kept(mask.nonzero()[:, 0], None)
        size = self._sizes[stage]
        place = mask.cumsum(0)
        self._note(stage, place[-1])
        target = torch.where(mask & (place <= size), place - 1, size)
        number = torch.arange(size + 1, device=mask.device)
        index = (number % len(mask)).scatter(0, target, torch.arange(len(mask), device=mask.device))
        return Kept(index[:size], number[:size] < place[-1])

    def repeat(self, stage: int, counts: torch.Tensor) -> tuple[Kept, torch.Tensor]:
        """Entry i ``counts[i]`` times; and which of its repeats each is, from 0 on."""
        ends = counts.cumsum(0)
        if self._sizes is None:
            entry = torch.repeat_interleave(counts)
            return Kept(entry, None), torch.arange(len(entry), device=counts.device) - (ends - counts)[entry]
        self._note(stage, ends[-1])
        number = torch.arange(self._sizes[stage], device=counts.device)
        used = number < ends[-1]
        entry = torch.where(used, torch.searchsorted(ends, number, right=True), number % len(counts))
        return Kept(entry, used), torch.where(used, number - (ends - counts)[entry], 0)

    def _note(self, stage: int, need: torch.Tensor) -> None:
        self._most[stage] = torch.maximum(self._most[stage], need)

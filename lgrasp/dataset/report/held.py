"""Rows by the number of objects in the hand, and by the opposition space that took the last of them."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lgrasp.dataset.report.physics import Verdicts, add_verdicts
from lgrasp.dataset.report.quantity import QUANTITIES, Distribution
from lgrasp.grasp.records import GraspRows

(_PENETRATION,) = (q for q in QUANTITIES if q.name == "penetration")


@dataclass
class HeldRows:
    """Rows with one number of objects in the hand."""

    rows: int = 0
    penetration: Distribution = field(default_factory=lambda: Distribution(_PENETRATION))
    verdicts: dict[str, Verdicts] = field(default_factory=dict)
    """By protocol."""
    spaces: dict[str, "HeldRows"] = field(default_factory=dict)
    """The same of the rows whose last object was taken with one opposition space, by its name."""

    def add(self, rows: GraspRows, chosen: np.ndarray) -> None:
        """Count some of the rows, by index [n]."""
        self.rows += len(chosen)
        if _PENETRATION.name in rows.metrics:
            self.penetration.add(rows.metrics[_PENETRATION.name][chosen])
        columns = {name: values[chosen] for name, values in rows.physics.items()}
        add_verdicts(self.verdicts, columns, rows.physics_protocols)

    def numbers(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return {
            "rows": self.rows,
            "penetration": self.penetration.numbers() if self.penetration.rows else None,
            "physics": {
                name: {key: value for key, value in verdicts.numbers().items() if key in ("run", "held", "share")}
                for name, verdicts in self.verdicts.items()
            },
        }


def add_held(into: dict[int, HeldRows], rows: GraspRows) -> None:
    """Count rows by their number of objects.

    Args:
        into: Counts so far, by number of objects.
        rows: Further rows.
    """
    count = (rows.object_index >= 0).sum(1)
    for n in np.unique(count):
        chosen = np.flatnonzero(count == n)
        group = into.setdefault(int(n), HeldRows())
        group.add(rows, chosen)
        if rows.sequence is None:
            continue
        last = rows.sequence.space[chosen, n - 1]
        for number, name in enumerate(rows.sequence.space_names):
            group.spaces.setdefault(name, HeldRows()).add(rows, chosen[last == number])


def held_numbers(held: Mapping[int, HeldRows]) -> dict[str, Any]:
    """JSON-serialisable, by number of objects; ``spaces`` is empty for rows that are no sequences."""
    return {
        str(n): group.numbers() | {"spaces": {name: space.numbers() for name, space in group.spaces.items()}}
        for n, group in sorted(held.items())
    }

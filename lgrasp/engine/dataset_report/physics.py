"""Verdicts of simulators: how many grasps hold, and in which direction the others fail."""

import json
from dataclasses import dataclass, field
from typing import Any

import numpy as np

__all__ = ["DIRECTIONS", "Verdicts"]

DIRECTIONS = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Of the six columns of ``P_directions``."""

_NAMES = ("holds", "directions")


@dataclass
class Verdicts:
    """Counts of one protocol: of its columns ``P_holds`` [N] and ``P_directions`` [N, 6]."""

    protocols: list[str] = field(default_factory=list)
    """Texts of the protocol, different ones once each."""
    run: int = 0
    held: int = 0
    direction_run: np.ndarray = field(default_factory=lambda: np.zeros(len(DIRECTIONS), np.int64))
    direction_failed: np.ndarray = field(default_factory=lambda: np.zeros(len(DIRECTIONS), np.int64))

    @staticmethod
    def add(into: dict[str, "Verdicts"], column: str, values: np.ndarray, protocol: str) -> None:
        """Count a column of ``physics/``; others than the two are passed over, values below 0 and NaN were not run."""
        name, _, what = column.rpartition("_")
        if what not in _NAMES or not name:
            return
        verdicts = into.setdefault(name, Verdicts())
        if protocol not in verdicts.protocols:
            verdicts.protocols.append(protocol)
        run = values >= 0  # NaN: false
        if what == "holds" and values.ndim == 1:
            verdicts.run += int(run.sum())
            verdicts.held += int((values[run] > 0).sum())
        elif what == "directions" and values.shape[1:] == (len(DIRECTIONS),):
            verdicts.direction_run += run.sum(0)
            verdicts.direction_failed += (run & (values == 0)).sum(0)

    def numbers(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return {
            "run": self.run,
            "held": self.held,
            "share": self.held / self.run if self.run else None,
            "directions": {
                way: {"run": int(run), "failed": int(failed)}
                for way, run, failed in zip(DIRECTIONS, self.direction_run, self.direction_failed, strict=True)
            },
            "protocols": [_parsed(text) for text in self.protocols],
        }


def _parsed(text: str) -> Any:
    """A protocol's settings if it is a JSON object, else its text."""
    try:
        settings = json.loads(text)
    except ValueError:
        return text
    return settings if isinstance(settings, dict) else text

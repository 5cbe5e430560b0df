"""Verdicts of simulators: how many grasps hold, and in which direction the others fail."""

import json
import re
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lgrasp.dataset.report.quantity import QUANTITIES, Distribution
from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.protocol import DIRECTIONS

_HOLDS, _DIRECTIONS = "_holds", "_directions"
_REACH, _OK = "reach", "_ok"
_HOLD_TEST, _OF_HOLD = "hold_test", ("hold_success", "hold_probability", "hold_drift")
_PASSED = re.compile(f"(.+){_HOLDS}|({_REACH}){_OK}")


def passed_words(name: str) -> str:
    """What a grasp does that has the verdict of some name."""
    others = {_REACH: "reached by the arm", _HOLD_TEST: "hold in the hold test"}
    return others.get(name, f"hold in physics ({name})")


@dataclass
class Verdicts:
    """Counts of one protocol P: of the columns ``P_holds`` [N] (``reach_ok`` of an arm), ``P_directions`` [N, 6] and
    further ``P_...`` [N], codes left out."""

    protocols: list[str] = field(default_factory=list)
    """Texts of the protocol, different ones once each."""
    run: int = 0
    held: int = 0
    direction_run: np.ndarray = field(default_factory=lambda: np.zeros(len(DIRECTIONS), np.int64))
    direction_failed: np.ndarray = field(default_factory=lambda: np.zeros(len(DIRECTIONS), np.int64))
    sums: dict[str, tuple[int, float]] = field(default_factory=dict)
    """Rows with a value and their sum, by further column."""

    def add(self, column: str, values: np.ndarray) -> None:
        """Count one column, named without the protocol; values below 0, NaN and infinite ones were not run."""
        run = (values >= 0) & np.isfinite(values)
        if column in (_HOLDS, _OK) and values.ndim == 1:
            self.run += int(run.sum())
            self.held += int((values[run] > 0).sum())
        elif column == _DIRECTIONS and values.shape[1:] == (len(DIRECTIONS),):
            self.direction_run += run.sum(0)
            self.direction_failed += (run & (values == 0)).sum(0)
        elif values.ndim == 1 and values.dtype != np.int8:
            count, total = self.sums.get(column[1:], (0, 0.0))
            self.sums[column[1:]] = count + int(run.sum()), total + float(values[run].sum(dtype=float))

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
            "means": {name: total / count if count else None for name, (count, total) in self.sums.items()},
            "protocols": [_parsed(text) for text in self.protocols],
        }


def add_verdicts(into: dict[str, Verdicts], rows: GraspRows, chosen: np.ndarray) -> None:
    """Count the columns of ``physics/`` of some rows, by protocol, and the metrics of the hold test; what belongs to
    none of these is passed over.

    Where one protocol's name begins another's, a column is of the longer one. ``chosen`` [n] are indices.
    """
    found = {column: match[1] or match[2] for column in rows.physics if (match := _PASSED.fullmatch(column))}
    names = found.values()
    for column, values in rows.physics.items():
        name = max((name for name in names if column.startswith(f"{name}_")), key=len, default=None)
        if name is not None:
            into.setdefault(name, Verdicts()).add(column.removeprefix(name), values[chosen])
    for column, name in found.items():
        text = rows.physics_protocols[column]
        if text not in into[name].protocols:
            into[name].protocols.append(text)
    for metric, column in zip(_OF_HOLD, (_HOLDS, "_probability", "_drift"), strict=True):
        if metric in rows.metrics:
            into.setdefault(_HOLD_TEST, Verdicts()).add(column, rows.metrics[metric][chosen])


def _parsed(text: str) -> Any:
    """A protocol's settings if it is a JSON object, else its text."""
    with suppress(ValueError):
        settings = json.loads(text)
        return settings if isinstance(settings, dict) else text
    return text


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
        add_verdicts(self.verdicts, rows, chosen)

    def numbers(self) -> dict[str, Any]:
        """JSON-serialisable."""
        shown = ("run", "held", "share")
        return {
            "rows": self.rows,
            "penetration": self.penetration.numbers() if self.penetration.rows else None,
            "physics": {name: {key: found.numbers()[key] for key in shown} for name, found in self.verdicts.items()},
        }


def add_held(into: dict[int, HeldRows], rows: GraspRows) -> None:
    """Count rows by their number of objects."""
    count = (rows.object_index >= 0).sum(1)
    for n in np.unique(count):
        chosen = np.flatnonzero(count == n)
        group = into.setdefault(int(n), HeldRows())
        group.add(rows, chosen)
        if rows.sequence is not None:
            last = rows.sequence.space[chosen, n - 1]
            for number, name in enumerate(rows.sequence.space_names):
                group.spaces.setdefault(name, HeldRows()).add(rows, chosen[last == number])


def held_numbers(held: Mapping[int, HeldRows]) -> dict[str, Any]:
    """JSON-serialisable, by number of objects; ``spaces`` is empty for rows that are no sequences."""
    return {
        str(n): group.numbers() | {"spaces": {name: space.numbers() for name, space in group.spaces.items()}}
        for n, group in sorted(held.items())
    }

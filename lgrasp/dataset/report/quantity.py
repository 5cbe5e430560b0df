"""The metrics that the report shows, and their distribution over any number of rows in bounded memory."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

_HISTOGRAM_CELLS = 4096


@dataclass(frozen=True)
class Quantity:
    """How one metric is shown."""

    name: str
    title: str
    top: float
    """No value is larger, or it counts as this; in the file's unit."""
    unit: str = ""
    factor: float = 1.0
    """From the file's unit to ``unit``."""
    bound: float | None = None
    """Largest value of a strictly valid grasp, in ``unit``, as the judge has it."""
    highest_is_worst: bool = True
    by_friction: bool = False
    """Measured with the friction of the run."""


QUANTITIES = (
    Quantity("penetration", "Penetration of hand and object", 1.0, "mm", 1e3, 2.0),
    Quantity("self_penetration", "Self-penetration of the hand", 1.0, "mm", 1e3, 1.0),
    Quantity("gap", "Gap at contacts", 1.0, "mm", 1e3, 2.0),
    Quantity("normal_error", "Angle of the normals at contacts", np.pi, "deg", 180 / np.pi, 20.0),
    Quantity("gswo", "Friction wrench residual (gswo)", 20.0, bound=0.05, by_friction=True),
    Quantity("unresisted_load", "Unresisted part of a load", 1.0),
    Quantity("epsilon", "Ferrari-Canny epsilon", 1.5, highest_is_worst=False),
    Quantity("epsilon_exact", "Ferrari-Canny epsilon, exact hull", 1.5, highest_is_worst=False),
    Quantity("volume", "Volume of the wrench hull", 2.0, highest_is_worst=False),
)


@dataclass
class Distribution:
    """Counts of a quantity's values in cells between fourth powers: medians within one or two percent."""

    quantity: Quantity
    counts: np.ndarray = field(default_factory=lambda: np.zeros(_HISTOGRAM_CELLS, np.int64))
    rows: int = 0
    missing: int = 0
    """Rows where it was not measured (NaN)."""
    zeros: int = 0
    """Rows where it is 0 (or less)."""
    over: int = 0
    """Rows above the bound."""
    least: float = np.inf
    most: float = -np.inf

    def add(self, values: np.ndarray, *, strict: bool = True) -> None:
        """Count further values, shape [n], in the file's unit.

        Args:
            strict: their shard is :func:`~lgrasp.grasp.bounds.measured_strictly`; else those by friction are above
                the bound.
        """
        good = values[np.isfinite(values)].astype(float)
        self.missing += len(values) - len(good)
        self.rows += len(good)
        if len(good):
            cell = np.clip(good / self.quantity.top, 0, 1) ** 0.25 * _HISTOGRAM_CELLS
            self.counts += np.bincount(np.minimum(cell.astype(int), _HISTOGRAM_CELLS - 1), minlength=_HISTOGRAM_CELLS)
            self.zeros += int((good <= 0).sum())
            shown = good * self.quantity.factor
            self.least, self.most = min(self.least, float(shown.min())), max(self.most, float(shown.max()))
            if self.quantity.bound is not None:
                other = self.quantity.by_friction and not strict
                self.over += len(shown) if other else int((shown > self.quantity.bound).sum())

    def merge(self, other: "Distribution") -> None:
        """Take the counts of another one of the same quantity."""
        for name in ("counts", "rows", "missing", "zeros", "over"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        self.least, self.most = min(self.least, other.least), max(self.most, other.most)

    def edges(self) -> np.ndarray:
        """Edges of the cells in the shown unit, shape [cells + 1]."""
        return self.quantity.top * self.quantity.factor * np.linspace(0, 1, _HISTOGRAM_CELLS + 1) ** 4

    def quantile(self, share: float) -> float:
        """Value below which a share of the rows lies, in the shown unit; there are rows. Those of a cell are spread
        evenly in it; between two rows it is interpolated, as of numpy.quantile."""
        place = share * (self.rows - 1)
        ranks = np.array([np.floor(place), np.ceil(place)])
        ends, edges = np.cumsum(self.counts), self.edges()
        cell = np.searchsorted(ends, ranks, side="right")
        within = (ranks + 0.5 - (ends - self.counts)[cell]) / self.counts[cell]
        low, high = np.clip(edges[cell] + within * (edges[cell + 1] - edges[cell]), self.least, self.most)
        return float(low + (place - ranks[0]) * (high - low))

    def bars(self) -> tuple[np.ndarray, np.ndarray]:
        """Edges [41] and counts [40] of even bins that show nearly all values above 0, and the bound."""
        high = max(self.quantile(0.999), self.most if self.rows < 5000 else 0.0, self.quantity.bound or 0.0) or 1.0
        edges = np.linspace(0, 1.02 * high, 41)
        middle = (self.edges()[1:] + self.edges()[:-1]) / 2
        counts = self.counts.copy()
        counts[0] -= self.zeros
        return edges, np.histogram(np.minimum(middle, edges[-1]), edges, weights=counts)[0]

    def numbers(self) -> dict[str, Any]:
        """JSON-serialisable: worst, median and more, in ``unit``; there are rows."""
        q = self.quantity
        return {
            "unit": q.unit,
            "rows": self.rows,
            "missing": self.missing,
            "min": self.least,
            "median": self.quantile(0.5),
            "p95": self.quantile(0.95),
            "max": self.most,
            "worst": self.most if q.highest_is_worst else self.least,
            "zero": self.zeros,
            "bound": q.bound,
            "over_bound": self.over if q.bound is not None else None,
        }

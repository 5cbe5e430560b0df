"""Losses along a training, as the card of a network keeps them, and their picture."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from lgrasp.errors import ConfigError
from lgrasp.picture.sheet import write_plot

POINTS = 100
"""Of a curve at most."""

Curves = Mapping[str, Mapping[str, list[list[float]]]]
"""Part of the training -> what was measured -> points (step, value)."""


class LossCurve:
    """Keeps losses that a training tells as (step, loss), in stretches of whole turns: ``turn`` steps, one for each
    object."""

    def __init__(self, steps: int, *, turn: int = 1) -> None:
        self.points: list[list[float]] = []
        """Last step and mean loss of each of as many equal stretches."""
        self._steps, self._stretch = steps, math.ceil(steps / POINTS / turn) * turn
        self._recent: list[float] = []

    def __call__(self, step: int, loss: float) -> None:
        self._recent.append(loss)
        last = self.points[-1][0] if self.points else 0
        if step - last >= self._stretch or step >= self._steps:
            add_point(self.points, step, sum(self._recent) / len(self._recent))
            self._recent = []

    def state_dict(self) -> dict[str, list[Any]]:
        """Of an interrupted training."""
        return {"points": self.points, "recent": self._recent}

    def load_state_dict(self, state: Mapping[str, list[Any]]) -> None:
        """Go on from a :meth:`state_dict`."""
        self.points, self._recent = state["points"], state["recent"]


def add_point(points: list[list[float]], step: int, value: float) -> None:
    """Add (step, value) with six digits to a curve.

    Raises:
        ConfigError: the value is not finite.
    """
    if not math.isfinite(value):
        raise ConfigError(f"the training diverged: its loss is {value} at step {step:,}; lower the rates (--set)")
    points.append([step, float(f"{value:.6g}")])


def draw_curves(curves: Curves, title: str, path: Path) -> None:
    """A PNG with a plot for each part of the training.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2 * len(curves), 3.2), dpi=100, layout="constrained")
    for axes, (part, measured) in zip(figure.subplots(1, len(curves), squeeze=False)[0], curves.items(), strict=True):
        _draw(axes, measured)
        axes.set_title(part)
    figure.suptitle(title)
    write_plot(figure, path)


def _draw(axes: Any, measured: Mapping[str, list[list[float]]]) -> None:
    for name, points in measured.items():
        axes.plot([step for step, _ in points], [value for _, value in points], label=name)
    axes.set(xlabel="step")
    axes.set_ylim(bottom=0)
    axes.grid(alpha=0.3)
    axes.legend(frameon=False)

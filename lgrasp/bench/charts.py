"""A benchmark table as bars, without a display."""

from pathlib import Path
from typing import Any

from lgrasp.picture.sheet import write_plot

_COLOURS = ("#1f77b4", "#ff7f0e", "#2ca02c", "#9467bd")
_PUBLISHED = "#b0b0b0"
_BARS = 0.84  # of the distance between two objects


def draw_table(table: dict[str, Any], path: Path) -> None:
    """One picture per hand in one PNG: strict-valid grasps per second of each object, on a log scale.

    One bar per pipeline with whiskers from the lowest to the highest run, and the published figure beside them.

    Args:
        table: of :func:`lgrasp.bench.comparison.measure_table`.

    Raises:
        OutputError: the file cannot be written.
    """
    from matplotlib.figure import Figure

    hands = [mean["hand"] for mean in table["means"]]
    across = min(2, max(1, len(hands)))
    down = max(1, -(-len(hands) // across))
    figure = Figure(figsize=(1.6 + 6.4 * across, 1.2 + 3.6 * down), dpi=100, layout="constrained")
    for i, hand in enumerate(hands):
        axes = figure.add_subplot(down, across, i + 1)
        _draw_hand(axes, table, [cell for cell in table["cells"] if cell["hand"] == hand and not cell["error"]])
        axes.set_title(hand)
    settings = table["settings"]
    figure.suptitle(f"strict-valid grasps per second, {settings['device']}, median of {settings['repeat']}")
    if hands:
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    write_plot(figure, path)


def _draw_hand(axes: Any, table: dict[str, Any], cells: list[dict[str, Any]]) -> None:
    names = table["settings"]["pipelines"]
    published = table["published"]
    width = _BARS / (len(names) + bool(published))
    for k, name in enumerate(names):
        rates = [c["pipelines"][name]["strict_valid_per_s"] for c in cells]
        middle = [rate["median"] for rate in rates]
        spread = [[r["median"] - r["min"] for r in rates], [r["max"] - r["median"] for r in rates]]
        at = [i + (k + 0.5) * width - _BARS / 2 for i in range(len(cells))]
        axes.bar(
            at, middle, width, yerr=spread, color=_COLOURS[k % len(_COLOURS)], label=name, error_kw={"elinewidth": 0.8}
        )
    if published:
        at = [i + _BARS / 2 - width / 2 for i in range(len(cells))]
        figures = [c["published_per_s"] or 0.0 for c in cells]
        axes.bar(at, figures, width, color=_PUBLISHED, label=f"published, {published['device']}")
    axes.set_yscale("log")
    axes.set_xticks(range(len(cells)), [c["object"] for c in cells], rotation=30, ha="right")
    axes.grid(axis="y", which="major", alpha=0.4)
    axes.set_axisbelow(True)

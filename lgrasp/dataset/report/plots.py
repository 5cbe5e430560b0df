"""The report's charts as SVG text: colour-blind-safe, in the colour of the page's text, legible on light and dark."""

import io
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.report.diversity import Posture
from lgrasp.dataset.report.quantity import Distribution

MAPS = 12

_LAYOUT = "constrained"
_LAST_LABEL = 0.985  # share of the width that axes take: half of an axis' last label is beyond
_INK = "#010203"  # of charts.mplstyle; replaced by currentColor
_BAR = "#2f86c9"
_BOUND = "#d55e00"
_COLOURS = ("#2f86c9", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#b3a100", "#7f7f7f")  # after Okabe, Ito
_LINKS = 24
_FINE = 6  # cells drawn for a bin, along each side: its edges are curved


@contextmanager
def _figure(width: float, height: float) -> Iterator[tuple[Any, Callable[[], str]]]:
    """A figure of some inches, and the function that gives its SVG."""
    import matplotlib
    from matplotlib.figure import Figure

    def svg() -> str:
        data = io.StringIO()
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "Glyph .* missing")  # the page's own fonts draw the text
            figure.savefig(data, format="svg", metadata={"Date": None, "Creator": None}, dpi=120)
        text = data.getvalue()
        return text[text.index("<svg") :].replace(_INK, "currentColor")

    with matplotlib.rc_context(fname=str(Path(__file__).with_name("charts.mplstyle"))):
        figure = Figure(figsize=(width, height), layout=_LAYOUT)
        layout: Any = figure.get_layout_engine()
        if layout:
            layout.set(rect=(0, 0, _LAST_LABEL, 1))
        yield figure, svg


def quantity_chart(distributions: list[Distribution]) -> str:
    """Histograms side by side, three in a row, with the strict bound of each that has one."""
    down = -(-len(distributions) // 3)
    with _figure(10, 2.7 * down) as (figure, svg):
        for i, distribution in enumerate(distributions):
            _draw_distribution(figure.add_subplot(down, 3, i + 1), distribution)
        return svg()


def _draw_distribution(axes: Any, distribution: Distribution) -> None:
    quantity = distribution.quantity
    edges, counts = distribution.bars()
    axes.stairs(counts, edges, fill=True, color=_BAR)
    axes.set_title(quantity.title, pad=17)
    axes.set_xlabel(f"{quantity.name} [{quantity.unit}]" if quantity.unit else quantity.name)
    axes.set(ylabel="grasps", xlim=(0, edges[-1]), ylim=(0, max(1.05 * counts.max(), 1)))
    axes.grid(axis="y")
    notes = []
    if quantity.bound is not None:
        axes.axvline(quantity.bound, color=_BOUND, linewidth=1.2)
        notes.append(f"{distribution.over:,} above the bound, {quantity.bound:g}")
    if distribution.zeros:
        notes.append(f"{distribution.zeros / distribution.rows:.1%} are 0, left out")
    axes.text(0, 1.03, "; ".join(notes), transform=axes.transAxes, fontsize=8)


def contact_chart(group: dict[int, int], links: dict[str, float]) -> str:
    """Grasps by number of contacts, and each link's share of all contacts, largest first."""
    shown = list(links.items())[:_LINKS]
    with _figure(10, max(2.6, 0.8 + 0.19 * len(shown))) as (figure, svg):
        left, right = figure.subplots(1, 2, width_ratios=(1, 2))
        numbers = list(range(min(group, default=0), max(group, default=0) + 1))
        left.bar(numbers, [group.get(n, 0) for n in numbers], color=_BAR, width=0.8)
        left.set(xticks=numbers, title="Contacts per grasp", xlabel="contacts", ylabel="grasps")
        left.grid(axis="y")
        right.barh([name for name, _ in shown][::-1], [100 * s for _, s in shown][::-1], color=_BAR, height=0.75)
        more = f", the first {_LINKS} of {len(links)}" if len(links) > _LINKS else ""
        right.set(title=f"Contacts by link{more}", xlabel="share of all contacts [%]")
        right.grid(axis="x")
        right.set_ylim(-0.6, max(len(shown), 1) - 0.4)
        return svg()


def failure_chart(rows: Sequence[tuple[str, Mapping[str, Mapping[str, int]]]]) -> str:
    """Share of the grasps that fail in each direction, a group of bars per direction, a colour per protocol."""
    with _figure(10, 2.8) as (figure, svg):
        axes = figure.subplots()
        width = 0.8 / len(rows)
        for k, (name, directions) in enumerate(rows):
            shares = [100 * d["failed"] / d["run"] if d["run"] else 0.0 for d in directions.values()]
            at = np.arange(len(shares)) + (k + 0.5) * width - 0.4
            axes.bar(at, shares, 0.92 * width, color=_COLOURS[k % len(_COLOURS)], label=f" {name}")
        axes.set_xticks(range(len(rows[0][1])), list(rows[0][1]))
        axes.set(title="Failures by direction of the load", xlabel="direction in the frame of the hand's base")
        axes.set_ylabel("failed of those run [%]")
        axes.grid(axis="y")
        axes.legend()
        return svg()


def posture_chart(posture: Posture, scores: np.ndarray, group: np.ndarray, names: list[str]) -> str:
    """Explained variance of the principal components, and the first two scores [n, 2] of sampled rows, of which
    ``group`` [n] says the place in the names of the objects."""
    with _figure(10, 3.7) as (figure, svg):
        left, right = figure.subplots(1, 2, width_ratios=(1, 1.25))
        share = 100 * posture.share
        at = np.arange(1, len(share) + 1)
        left.bar(at, share, color=_BAR, width=0.8, label="each")
        left.plot(at, np.cumsum(share), color=_BOUND, marker="o", markersize=3, linewidth=1.2, label="together")
        left.xaxis.get_major_locator().set_params(integer=True)
        left.set(title="Variance of the joints explained", xlabel="principal component", ylabel="share [%]")
        left.set_ylim(0, 104)
        left.grid(axis="y")
        left.legend(loc="center right")
        _scatter(right, scores[:, 0], scores[:, 1], group, names)
        one, two = (f", {share[i]:.0f} %" if len(share) > i else "" for i in (0, 1))
        right.set(title="Postures on the first two components")
        right.set(xlabel=f"component 1 [rad]{one}", ylabel=f"component 2 [rad]{two}")
        right.set_aspect("equal", adjustable="datalim")
        _legend(right, names)
        return svg()


def position_chart(position: np.ndarray, group: np.ndarray, names: list[str]) -> str:
    """Middles of objects in the frame of the hand's base, seen along each axis: a sample [m], shape [n, 3], of which
    ``group`` [n] says the place in the names of the objects."""
    with _figure(10, 3.7) as (figure, svg):
        for axes, (i, j) in zip(figure.subplots(1, 3), ((0, 1), (0, 2), (1, 2)), strict=True):
            _scatter(axes, 1000 * position[:, i], 1000 * position[:, j], group, names)
            axes.plot(0, 0, marker="+", color=_INK, markersize=9, markeredgewidth=1.5)
            axes.set(title=f"Seen along {'xyz'[3 - i - j]}", xlabel=f"{'xyz'[i]} [mm]", ylabel=f"{'xyz'[j]} [mm]")
            axes.set_aspect("equal", adjustable="datalim")
        _legend(figure, names, loc="outside lower center", ncols=4)
        return svg()


def _scatter(axes: Any, x: np.ndarray, y: np.ndarray, group: np.ndarray, names: list[str]) -> None:
    """Dots in the colours of their objects, of one colour when there are more objects than colours."""
    dots = np.array(_COLOURS)[group] if len(names) <= len(_COLOURS) else _BAR
    size = float(np.clip(12_000 / max(len(x), 1), 1.5, 12))
    axes.scatter(x, y, s=size, c=dots, alpha=0.5, linewidths=0, rasterized=True)
    axes.grid()


def _legend(where: Any, names: list[str], **place: Any) -> None:
    from matplotlib.lines import Line2D

    if 1 < len(names) <= len(_COLOURS):
        style: Any = {"marker": "o", "linestyle": "", "markersize": 4}
        marks = [Line2D([], [], color=c, label=f" {name}", **style) for name, c in zip(names, _COLOURS, strict=False)]
        where.legend(handles=marks, **place)


def direction_maps(counts_by_object: dict[str, np.ndarray]) -> str:
    """Where the hand stands around each object (:attr:`Coverage.directions` by name), in equal-area (Mollweide) maps of
    the first twelve."""
    import matplotlib
    from matplotlib.colors import ListedColormap, LogNorm

    colours = ListedColormap(matplotlib.colormaps["cividis"](np.linspace(0.25, 1, 192)))  # apart from black and white
    shown = list(counts_by_object.items())[:MAPS]
    across = min(3, max(2, len(shown)))
    down = -(-len(shown) // across)
    hit = np.concatenate([counts[counts > 0] for _, counts in shown])
    low, high = int(hit.min()), max(int(hit.max()), int(hit.min()) + 1)
    with _figure(10, 10 / across * 0.55 * down + 0.2) as (figure, svg):
        drawn = None
        for i, (name, counts) in enumerate(shown):
            axes = figure.add_subplot(down, across, i + 1, projection="mollweide")
            longitude = np.linspace(-np.pi, np.pi, counts.shape[1] * _FINE + 1)
            latitude = np.arcsin(np.linspace(-1, 1, counts.shape[0] * _FINE + 1))
            values = np.ma.masked_equal(counts, 0).repeat(_FINE, 0).repeat(_FINE, 1)
            drawn = axes.pcolormesh(
                longitude, latitude, values, cmap=colours, norm=LogNorm(low, high), rasterized=True, linewidth=0
            )
            axes.set_title(f"{name}: {(counts > 0).mean():.0%} of {counts.size} bins", loc="center")
            axes.set_facecolor((0.5, 0.5, 0.5, 0.12))
            axes.set_xticks(np.radians([-90, 0, 90]), [])
            axes.set_yticks([0], [])
            axes.grid()
        ticks = [n * 10**k for k in range(8) for n in (1, 2, 5) if low <= n * 10**k <= high] or [low]
        bar = figure.colorbar(
            drawn, ax=figure.axes, label="grasps per bin", shrink=0.8 / down, aspect=15, format="{x:,.0f}"
        )
        bar.set_ticks(ticks[:: -(-len(ticks) // 7)], minor=False)
        bar.minorticks_off()
        return svg()

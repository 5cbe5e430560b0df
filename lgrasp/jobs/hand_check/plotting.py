"""Drawing of solids without a display: figures, shaded triangles, a camera that frames points."""

import io
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.files import write_file

_LIGHT = np.array([0.35, 0.25, 0.9]) / np.linalg.norm([0.35, 0.25, 0.9])


def new_figure(width: float, height: float) -> Any:
    """An empty figure of that size in inches."""
    import matplotlib

    matplotlib.use("Agg", force=False)
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=100, layout=None)
    FigureCanvasAgg(figure)
    figure.subplots_adjust(left=0.0, right=0.98, bottom=0.09, top=0.9, wspace=0.04)
    return figure


def save_figure(figure: Any, path: Path) -> Path:
    """Write the picture; gives its path back."""
    data = io.BytesIO()
    figure.savefig(data, format="png")
    write_file(path, data.getvalue())
    return path


def shade(triangles: np.ndarray, colour: str) -> np.ndarray:
    """Colours (n, 4) of triangles (n, 3, 3) under one light."""
    from matplotlib.colors import to_rgb

    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
    light = 0.55 + 0.45 * np.clip(normals @ _LIGHT, -0.6, 1)
    return np.column_stack([np.clip(light[:, None] * np.array(to_rgb(colour)), 0, 1), np.ones(len(light))])


def add_view(figure: Any, rows: int, columns: int, number: int, triangles: np.ndarray, colours: np.ndarray) -> Any:
    """Axes of place ``number``, from 0, of a figure, with triangles (n, 3, 3) [m] in their colours (n, 4)."""
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    axes = figure.add_subplot(rows, columns, number + 1, projection="3d")
    axes.add_collection3d(Poly3DCollection(triangles, facecolors=colours, edgecolors=colours, linewidths=0.2, zorder=1))
    return axes


def add_box(axes: Any, box: np.ndarray) -> None:
    """Edges of a box (2, 3)."""
    for a, b in product(product((0, 1), repeat=3), repeat=2):
        if a > b and np.abs(np.subtract(a, b)).sum() == 1:
            ends = box[0] + np.array([a, b]) * (box[1] - box[0])
            axes.plot(*ends.T, color="black", linewidth=1.6, zorder=9)


def frame_points(axes: Any, points: np.ndarray, towards: np.ndarray, turn: float) -> None:
    """Equal scales around points, camera on the side ``towards``, turned about z by ``turn`` degrees."""
    middle = (points.min(0) + points.max(0)) / 2
    half = float(np.ptp(points, axis=0).max()) / 2 * 0.95
    for axis, c in zip("xyz", middle, strict=True):
        getattr(axes, f"set_{axis}lim")(c - half, c + half)
        getattr(axes, f"set_{axis}label")(f"{axis} (m)", fontsize=8)
        axes.tick_params(axis=axis, labelsize=6)
    axes.set_box_aspect((1, 1, 1), zoom=1.1)
    axes.computed_zorder = False  # dots and lines are drawn over solids
    elevation = float(np.clip(np.degrees(np.arcsin(np.clip(towards[2], -1, 1))), -20, 55)) + 12
    axes.view_init(elev=elevation, azim=float(np.degrees(np.arctan2(towards[1], towards[0]))) + turn)

"""Plots as PNG files, without a display."""

import io
from pathlib import Path
from typing import TYPE_CHECKING

from lgrasp.errors import OutputError
from lgrasp.files import check_file, write_file

if TYPE_CHECKING:  # slow to import
    from matplotlib.figure import Figure


def check_plot(path: Path) -> None:
    """Check, before a long job, that a plot can be written there.

    Raises:
        OutputError: not a .png, a folder, or a place that cannot be written.
    """
    if path.suffix.lower() != ".png":
        raise OutputError(f"--plot {path}: the plot is a PNG; name a file that ends in .png")
    check_file(path)


def write_plot(figure: "Figure", path: Path) -> None:
    """Write a figure.

    Raises:
        OutputError: the file cannot be written.
    """
    data = io.BytesIO()
    figure.savefig(data, format="png")
    write_file(path, data.getvalue())

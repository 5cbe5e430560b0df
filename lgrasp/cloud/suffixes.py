"""Files that point clouds and masks are read from: their suffixes, and what their contents are called."""

from collections.abc import Sequence
from pathlib import Path

POINT_SUFFIXES = (".xyz", ".npy", ".npz")
"""Of files that hold nothing but points."""
CLOUD_SUFFIXES = (".ply", *POINT_SUFFIXES, ".h5")
MASK_SUFFIXES = (".npy", ".npz")


def cloud_names(paths: Sequence[Path], labels: Sequence[int]) -> tuple[str, ...]:
    """What the points of clouds, or of a label of each, are called."""
    return tuple(
        path.stem if number >= len(labels) else f"{path.stem}-{labels[number]}" for number, path in enumerate(paths)
    )

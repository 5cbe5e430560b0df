"""Brings row arrays of shards with different widths (objects in a row, most contacts) to one width."""

from collections.abc import Iterable

import numpy as np

from lgrasp.grasp.schema import GRASP_FIELDS, SEQUENCE_FIELDS


def pad_column(name: str, values: np.ndarray, tail: tuple[int, ...]) -> np.ndarray:
    """Values of one row dataset, padded at the end of each axis with the fill value of the format.

    Verdicts of a simulator, which may have a number per object, are padded with what means not run: NaN, -1 or false.

    Args:
        name: Flat name, as in :meth:`GraspRows.columns`.
        values: Shape [n, ...].
        tail: Wanted lengths of all axes but the first; none is shorter than in ``values``.

    Returns:
        Shape [n, *tail]; ``values`` itself if nothing is to be padded.
    """
    if values.shape[1:] == tail:
        return values
    spec = (GRASP_FIELDS | SEQUENCE_FIELDS).get(name)
    fill = spec.fill if spec else {"f": np.nan, "i": -1}.get(values.dtype.kind, 0)
    padded = np.full((len(values), *tail), fill, dtype=values.dtype)
    padded[tuple(slice(size) for size in values.shape)] = values
    return padded


def widest(tails: Iterable[tuple[int, ...]]) -> tuple[int, ...]:
    """The smallest tail that holds all given ones; they have the same number of axes."""
    return tuple(max(sizes) for sizes in zip(*tails, strict=True))

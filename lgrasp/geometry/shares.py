"""Items that are drawn in proportion to their weights, as a list to draw from evenly."""

import numpy as np


def entries_of(weights: np.ndarray, entries: int) -> np.ndarray:
    """How often each item is in a list of ``entries`` entries, (n,), in proportion to its weight (n,), not below 0."""
    upto = np.cumsum(weights) / weights.sum() * entries
    return np.diff(np.rint(upto).astype(int), prepend=0)

"""Rows without near-duplicates, decided pair by pair."""

import numpy as np

from lgrasp.grasp.duplicates import near_pairs


def new_rows(pose: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Mask (N,) of the rows that have no kept near-duplicate before them; rows are decided in order."""
    keep = np.ones(len(pose), bool)
    pairs = near_pairs(pose, q)
    for i, j in pairs[np.argsort(pairs[:, 1], kind="stable")]:
        if keep[i]:
            keep[j] = False
    return keep

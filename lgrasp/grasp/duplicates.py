"""Near-duplicates: object translation within 5 mm, rotation within 5 degrees and every joint within 0.1 rad."""

import numpy as np
from scipy.spatial import cKDTree

__all__ = ["NEAR_ANGLE", "NEAR_DISTANCE", "NEAR_JOINT", "near_pairs", "new_rows"]

NEAR_DISTANCE = 0.005  # [m]
NEAR_ANGLE = np.radians(5.0)
NEAR_JOINT = 0.1  # [rad or m]


def near_pairs(pose: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Index pairs (i < j), shape (n, 2), of rows that are near-duplicates of each other.

    Args:
        pose: object poses, shape (N, 7): x y z [m], then a unit quaternion in any fixed order.
        q: joints [rad or m], shape (N, K).
    """
    if len(pose) < 2:
        return np.zeros((0, 2), int)
    pairs = cKDTree(pose[:, :3]).query_pairs(NEAR_DISTANCE, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    near = np.abs(q[i] - q[j]).max(1) <= NEAR_JOINT
    i, j = i[near], j[near]
    cosine = np.abs((pose[i, 3:] * pose[j, 3:]).sum(1))
    near = cosine >= np.cos(NEAR_ANGLE / 2)
    out = np.column_stack([i[near], j[near]])
    return out[np.lexsort((out[:, 1], out[:, 0]))]


def new_rows(pose: np.ndarray, q: np.ndarray, known: int) -> np.ndarray:
    """Mask (N - known,) of the rows from ``known`` on that have no kept near-duplicate before them.

    The first ``known`` rows are kept already; later ones are decided in order.
    """
    keep = np.ones(len(pose), bool)
    pairs = near_pairs(pose, q)
    for i, j in pairs[np.argsort(pairs[:, 1], kind="stable")]:
        if j >= known and keep[i]:
            keep[j] = False
    return keep[known:]

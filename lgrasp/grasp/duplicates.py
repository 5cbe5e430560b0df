"""Near-duplicates: object translation within 5 mm, rotation within 5 degrees and every joint within 0.1 rad."""

import numpy as np
from scipy.spatial import cKDTree

__all__ = ["NEAR_ANGLE", "NEAR_DISTANCE", "NEAR_JOINT", "KeptRows", "near_pairs", "new_rows"]

NEAR_DISTANCE = 0.005  # [m]
NEAR_ANGLE = np.radians(5.0)
NEAR_JOINT = 0.1  # [rad or m]

_REACH = NEAR_DISTANCE * 1.001  # of the tree look-ups, which only propose pairs


def near_pairs(pose: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Index pairs (i < j), shape (n, 2), of rows that are near-duplicates of each other, sorted.

    Args:
        pose: object poses, shape (N, 7): x y z [m], then a unit quaternion in any fixed order.
        q: joints [rad or m], shape (N, K).
    """
    if len(pose) < 2:
        return np.zeros((0, 2), int)
    pairs = cKDTree(pose[:, :3]).query_pairs(_REACH, output_type="ndarray")
    i, j = pairs[:, 0], pairs[:, 1]
    pairs = pairs[_near(pose[i], q[i], pose[j], q[j])]
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


def new_rows(pose: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Mask (N,) of the rows that have no kept near-duplicate before them; rows are decided in order."""
    keep = np.ones(len(pose), bool)
    pairs = near_pairs(pose, q)
    for i, j in pairs[np.argsort(pairs[:, 1], kind="stable")]:
        if keep[i]:
            keep[j] = False
    return keep


class KeptRows:
    """Rows kept so far of a stream, without near-duplicates: the same ones however the stream is cut.

    The time per row grows with the logarithm of their number: rows lie in blocks, each at least twice as long as the
    next one.
    """

    def __init__(self) -> None:
        self._blocks: list[tuple[np.ndarray, np.ndarray, cKDTree]] = []
        self.count = 0

    def add(self, pose: np.ndarray, q: np.ndarray, room: int) -> tuple[np.ndarray, int]:
        """Keep what is new among further rows (see :func:`near_pairs`), up to ``room`` rows.

        Returns:
            Indices of the rows kept now, and the number of near-duplicates before the last of them (all of them
            unless the room ran out).
        """
        fresh = np.flatnonzero(~self._touched(pose, q))
        fresh = fresh[new_rows(pose[fresh], q[fresh])]
        kept = fresh[:room]
        looked_at = kept[-1] + 1 if len(kept) and len(kept) == room else len(pose)
        if len(kept):
            self.count += len(kept)
            self._append(pose[kept], q[kept])
        return kept, int(looked_at - len(kept))

    def _append(self, pose: np.ndarray, q: np.ndarray) -> None:
        while self._blocks and len(self._blocks[-1][0]) < 2 * len(pose):
            before_pose, before_q, _ = self._blocks.pop()
            pose, q = np.vstack([before_pose, pose]), np.vstack([before_q, q])
        self._blocks.append((pose, q, cKDTree(pose[:, :3])))

    def _touched(self, pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Mask (N,) of the rows that are near-duplicates of a kept row."""
        touched = np.zeros(len(pose), bool)
        for block_pose, block_q, tree in self._blocks:
            found = tree.query_ball_point(pose[:, :3], _REACH)
            i = np.repeat(np.arange(len(pose)), [len(rows) for rows in found])
            j = np.fromiter((row for rows in found for row in rows), int, len(i))
            touched[i[_near(pose[i], q[i], block_pose[j], block_q[j])]] = True
        return touched


def _near(pose_a: np.ndarray, q_a: np.ndarray, pose_b: np.ndarray, q_b: np.ndarray) -> np.ndarray:
    """Mask (N,): is each row of one table a near-duplicate of the same row of another?"""
    a, b = pose_a.astype(float), pose_b.astype(float)
    near = ((a[:, :3] - b[:, :3]) ** 2).sum(1) <= NEAR_DISTANCE**2
    near &= np.abs((a[:, 3:] * b[:, 3:]).sum(1)) >= np.cos(NEAR_ANGLE / 2)  # q and -q are one rotation
    return near & (np.abs(q_a - q_b) <= NEAR_JOINT).all(1)

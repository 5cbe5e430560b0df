"""Regions of an object that a shard says its grasps touch and avoid."""

import numpy as np
from scipy.spatial import cKDTree

from lgrasp.judge.bounds import REGION_WEIGHT, JudgeError


class JudgedRegions:
    """Surface points (S, 3) with their weights in what is to be touched and to be avoided, as rows (S, 5).

    Raises:
        JudgeError: numbers that are not finite, or a share out of range.
    """

    def __init__(self, points: np.ndarray, share: float) -> None:
        if not np.isfinite(points).all() or not 0.0 < share <= 1.0:
            raise JudgeError(f"regions: numbers that are not finite, or share {share:g}, which is not in (0, 1]")
        self.tree = cKDTree(points[:, :3])
        self.touch, self.avoid = (points[:, k] >= REGION_WEIGHT for k in (3, 4))
        self.share = share

    def judge(
        self, points: np.ndarray, normals: np.ndarray, forces: np.ndarray, used: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Of rows with contacts (n, C, 3), those that are ``used`` (n, C): what is missing on the part to be touched
        (of the contacts if all must be there, else of the share of the normal force), and contacts on the part to be
        avoided; (n,) each.
        """
        on, off = np.zeros(used.shape, bool), np.zeros(used.shape, bool)
        nearest = self.tree.query(points[used])[1]
        on[used], off[used] = self.touch[nearest], self.avoid[nearest]
        # every contact counts alike where all must be on the part
        push = np.ones(used.shape) if self.share == 1.0 else -(forces * normals).sum(axis=-1)
        push = np.where(used, push, 0.0)
        there = np.where(on, push, 0.0).sum(axis=1) / np.maximum(push.sum(axis=1), 1e-12)
        return np.maximum(self.share - there, 0.0), off.sum(axis=1).astype(float)

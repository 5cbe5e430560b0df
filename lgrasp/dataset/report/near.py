"""Near-duplicates and distinct object poses of one hand with one object (or one set of them), as rows come."""

import numpy as np

from lgrasp.grasp.duplicates import KeptRows, near_pairs

_MAX_ROWS = 2_000_000  # rows held for comparison


class NearRows:
    """Rows that are near-duplicates of a row before them.

    With one object every row is compared with all rows kept so far, up to two million. With several, all of which must
    be near, it is compared within the rows of one call.
    """

    def __init__(self) -> None:
        self.compared = self.duplicates = self.poses = 0
        self._kept: KeptRows | None = None
        self._last: np.ndarray | None = None

    def add(self, pose: np.ndarray, q: np.ndarray) -> None:
        """Compare further rows.

        Args:
            pose: Object poses, shape [n, o, 7]; the same ones present in every row.
            q: Joints, shape [n, K].
        """
        if not len(pose):
            return
        self._count_poses(np.ascontiguousarray(pose.reshape(len(pose), -1)))
        if pose.shape[1] > 1:
            self._compare_sets(pose, q)
            return
        self._kept = self._kept or KeptRows(q.shape[1])
        room = _MAX_ROWS - self._kept.count
        if room > 0:
            kept, near = self._kept.add(pose[:, 0], q, room)
            self.compared += len(kept) + near
            self.duplicates += near

    def close(self) -> None:
        """Forget the rows, keep the counts."""
        self._kept = None

    def _compare_sets(self, pose: np.ndarray, q: np.ndarray) -> None:
        n = len(q)
        near = [i * n + j for i, j in (near_pairs(pose[:, o], q).T for o in range(pose.shape[1]))]
        shared = near[0]
        for pairs in near[1:]:
            shared = np.intersect1d(shared, pairs)
        drop = np.zeros(n, bool)
        for i, j in sorted((int(p // n), int(p % n)) for p in shared):  # by the earlier row, so it is decided
            drop[j] |= not drop[i]
        self.compared += n
        self.duplicates += int(drop.sum())

    def _count_poses(self, pose: np.ndarray) -> None:
        """Rows of one object pose follow one another; a call may begin in the midst of them."""
        self.poses += len(np.unique(pose, axis=0))
        if self._last is not None and np.array_equal(self._last, pose[0]):
            self.poses -= 1
        self._last = pose[-1]

"""Near-duplicates: object translation within 5 mm, rotation within 5 degrees and every joint within 0.1 rad."""

import numpy as np
import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.fetch import fetch
from lgrasp.runtime.structs import upload_struct

NEAR_DISTANCE = 0.005  # [m]
NEAR_ANGLE = np.radians(5.0)
NEAR_JOINT = 0.1  # [rad or m]

_LOOKUP_REACH = NEAR_DISTANCE * 1.001  # of the grid look-ups, which only propose pairs

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Near:
    """N rows, and how near duplicates are."""

    position: wp.array(dtype=wp.vec3)  # (N,) [m]
    rotation: wp.array(dtype=wp.vec4)  # (N,) quaternion
    q: wp.array2d(dtype=wp.float32)  # (N, K) [rad or m]
    reach: wp.float32  # [m]
    cosine: wp.float32  # least, of half the angle
    joint: wp.float32  # [rad or m]


@wp.func
def _is_near(x: Near, a: wp.int32, b: wp.int32):
    d = x.position[a] - x.position[b]
    if wp.dot(d, d) > x.reach * x.reach or wp.abs(wp.dot(x.rotation[a], x.rotation[b])) < x.cosine:
        return False
    same = bool(True)
    for k in range(x.q.shape[1]):
        if wp.abs(x.q[a, k] - x.q[b, k]) > x.joint:
            same = False
            break
    return same


@wp.kernel
def list_near(
    grid: wp.uint64,
    x: Near,
    rows: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    near_out: wp.array(dtype=wp.int32),
):
    """Rows near each of some rows and before it: counted, and written from place ``first`` on (empty: counted only).

    Args:
        rows: the rows that are asked about, (n,).
        first: place of each one's list, (n,) or (0,).
        count_out: near rows of each, (n,).
        near_out: the lists, (all,).
    """
    i = wp.tid()
    row = rows[i]
    n = int(0)
    query = wp.hash_grid_query(grid, x.position[row], x.reach)
    other = int(0)
    while wp.hash_grid_query_next(query, other):
        if other < row and _is_near(x, row, other):
            if first.shape[0] > 0:
                near_out[first[i] + n] = other
            n += 1
    count_out[i] = n


def near_pairs(pose: np.ndarray, q: np.ndarray, device: str = "cpu") -> np.ndarray:
    """Index pairs (i < j), shape (n, 2), of rows that are near-duplicates of each other, sorted.

    Args:
        pose: object poses, shape (N, 7): x y z [m], then a unit quaternion in any fixed order.
        q: joints [rad or m], shape (N, K).
    """
    if len(pose) < 2:
        return np.zeros((0, 2), int)
    start()
    pairs = _NearRows(device).before(pose, q, 0)
    return pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]


class KeptRows:
    """Rows kept so far of a stream, without near-duplicates: the same ones however the stream is cut.

    A hash grid over object positions (on the job's device) tells which rows have any row close before them; those few
    are then decided in order.
    """

    def __init__(self, joints: int, device: str = "cpu") -> None:
        start()
        self._near = _NearRows(device)
        self._pose = np.zeros((0, 7), np.float32)
        self._q = np.zeros((0, joints), np.float32)
        self.count = 0

    def close(self) -> None:
        """Free what is on the device; no rows can be added from now on."""
        del self._near

    def restore(self, pose: np.ndarray, q: np.ndarray) -> None:
        """Begin with rows that were kept before: poses (N, 7) and joints (N, K)."""
        self._pose, self._q = np.array(pose, np.float32), np.array(q, np.float32)
        self.count = len(pose)

    def add(self, pose: np.ndarray, q: np.ndarray, room: int) -> tuple[np.ndarray, int]:
        """Keep what is new among further rows (see :func:`near_pairs`), up to ``room`` rows.

        Returns:
            Indices of the rows kept now, and the number of near-duplicates before the last of them (all of them
            unless the room ran out).
        """
        if len(pose) == 0:
            return np.zeros(0, int), 0
        end = self.count + len(pose)
        if end > len(self._pose):
            self._pose, self._q = (_longer(a, self.count, 2 * end) for a in (self._pose, self._q))
        self._pose[self.count : end], self._q[self.count : end] = pose, q
        keep = np.ones(end, bool)
        pairs = self._near.before(self._pose[:end], self._q[:end], self.count)
        old = pairs[:, 0] < self.count
        keep[pairs[old, 1]] = False
        for before, row in pairs[~old].tolist():
            keep[row] &= not keep[before]
        kept = np.flatnonzero(keep[self.count :])[:room]
        looked_at = kept[-1] + 1 if len(kept) and len(kept) == room else len(pose)
        after = self.count + len(kept)
        self._pose[self.count : after], self._q[self.count : after] = pose[kept], q[kept]
        self.count = after
        return kept, int(looked_at - len(kept))


class _NearRows:
    """Finds near-duplicates with a hash grid over object positions."""

    def __init__(self, device: str) -> None:
        self._device = device
        self._grid = wp.HashGrid(128, 128, 128, device=device)

    def before(self, pose: np.ndarray, q: np.ndarray, first: int) -> np.ndarray:
        """Pairs (i < j), shape (n, 2), of near-duplicates of which j is at least ``first``, by rising j."""
        d = self._device
        # with some slack for rounding: pairs are decided in double precision below
        limits = {"reach": _LOOKUP_REACH, "cosine": np.cos(NEAR_ANGLE / 2) - 1e-6, "joint": NEAR_JOINT * 1.00001}
        x = upload_struct(Near, d, {"position": pose[:, :3], "rotation": pose[:, 3:], "q": q, **limits})
        self._grid.build(x.position, _LOOKUP_REACH)

        def listed(asked: np.ndarray, places: np.ndarray, room: int) -> tuple[np.ndarray, np.ndarray]:
            """How many rows are near before each one asked and, given places for them, which."""
            number, others = (wp.empty(n, dtype=wp.int32, device=d) for n in (len(asked), room))
            given = [wp.array(a, dtype=wp.int32, device=d) for a in (asked, places)]
            wp.launch(list_near, len(asked), [self._grid.id, x, *given], [number, others], device=d)
            number, others = fetch([number, others], others=True)
            return number, others

        rows = np.arange(first, len(pose))
        number, _ = listed(rows, rows[:0], 0)
        rows, number = rows[number > 0], number[number > 0]
        if len(rows) == 0:
            return np.zeros((0, 2), int)
        _, other = listed(rows, np.cumsum(number) - number, int(number.sum()))
        row = np.repeat(rows, number)
        same = _near(pose[other], q[other], pose[row], q[row])
        return np.stack([other[same], row[same]], 1).astype(int)


def _longer(array: np.ndarray, count: int, length: int) -> np.ndarray:
    """The first rows of an array in one with room for more."""
    out = np.empty((length, array.shape[1]), array.dtype)
    out[:count] = array[:count]
    return out


def _near(pose_a: np.ndarray, q_a: np.ndarray, pose_b: np.ndarray, q_b: np.ndarray) -> np.ndarray:
    """Mask (N,): True where a row of one table is a near-duplicate of the same row of another."""
    a, b = pose_a.astype(float), pose_b.astype(float)
    near = ((a[:, :3] - b[:, :3]) ** 2).sum(1) <= NEAR_DISTANCE**2
    near &= np.abs((a[:, 3:] * b[:, 3:]).sum(1)) >= np.cos(NEAR_ANGLE / 2)  # q and -q are one rotation
    return near & (np.abs(q_a - q_b) <= NEAR_JOINT).all(1)

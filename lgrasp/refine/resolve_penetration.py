"""Takes hands that are deep in an object out before the search: through a thin wall the gradient leads either way."""

from typing import Protocol

import numpy as np

from lgrasp.geometry.poses import device_rotation
from lgrasp.hand.tree import Tree
from lgrasp.refine.hands import Hands

_DEEP_PENETRATION = 0.002  # [m] hands deeper than this are taken out
_FREE_PENETRATION = 0.0005  # [m] those less deep are out
_STRAIGHT_STEP = 0.002  # [m]
_DIRECTIONS = np.array([w for w in np.ndindex(3, 3, 3) if w != (1, 1, 1)]) - 1.0
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)
_OPENING_SHARES = np.linspace(0.25, 1, 4)  # shares of the way to the open posture
_BACK_STEP, _BACK_FACTOR = 0.004, 4.0  # step [m], and how much farther than straight out an opened hand may go


class Depths(Protocol):
    """What knows how deep hands are."""

    device: str

    def max_penetration(self, at: Hands) -> np.ndarray:
        """Depth of the deepest point [m], negative apart, (N,)."""
        ...


def resolve_penetration(search: Depths, tree: Tree, back: np.ndarray, at: Hands, most: float) -> None:
    """Move deep hands out, in place: straight along the shortest of some ways, or else opened and back.

    Args:
        back: direction away from what the palm faces, base frame, (3,).
        most: how far straight at most [m].
    """
    least = search.max_penetration(at)
    left = np.flatnonzero(least > _DEEP_PENETRATION)
    if len(left) == 0:
        return
    pose, q = (x.copy() for x in at.arrays())
    given, joints = pose.copy(), q.copy()

    def attempt(shifts: np.ndarray, opened: np.ndarray) -> None:
        """Hands that are left take the best of some changes: shifts (n, W, 3) [m], shares opened (W,)."""
        nonlocal left
        ways = len(opened)
        tried, bent = (x[left][:, None].repeat(ways, 1) for x in (given, joints))
        tried[..., :3] += shifts
        bent += opened[:, None] * (tree.joint_open - bent)
        depth = search.max_penetration(Hands.put(tried.reshape(-1, 7), bent.reshape(-1, q.shape[1]), search.device))
        depth = depth.reshape(-1, ways)
        free = depth < _FREE_PENETRATION
        best = np.where(free.any(1), free.argmax(1), depth.argmin(1))
        found = depth[np.arange(len(left)), best]
        better = found < least[left]
        rows = left[better]
        pose[rows], q[rows], least[rows] = tried[better, best[better]], bent[better, best[better]], found[better]
        left = left[least[left] > _FREE_PENETRATION]

    for number in range(1, int(most / _STRAIGHT_STEP + 1e-9) + 1):
        if len(left):
            attempt(number * _STRAIGHT_STEP * _DIRECTIONS[None], np.zeros(len(_DIRECTIONS)))
    for number in range(int(_BACK_FACTOR * most / _BACK_STEP + 1e-9) + 1):
        if len(left):
            away = device_rotation(given[left]).apply(back)
            attempt(number * _BACK_STEP * away[:, None].repeat(len(_OPENING_SHARES), 1), _OPENING_SHARES)
    at.pose.assign(pose)
    at.q.assign(q)

"""How much of the ways to hold an object a data set shows: counts over bins of equal size."""

from typing import Any

import numpy as np

BANDS, TURNS = 12, 24  # of the sphere: bands of equal height, sectors of equal angle
_ROTATION = (6, 12, 12)  # cos(theta), phi, psi of Rz(phi) Ry(theta) Rz(psi)


class Coverage:
    """Bins of approach directions and of rotations, each of equal solid angle or rotation volume.

    The approach direction points from the object's middle to the origin of the hand's base, in the object's frame:
    where the hand stands around the object. Bands of equal height and equal sectors of the unit sphere have equal area.
    A rotation Rz(phi) Ry(theta) Rz(psi) has the uniform measure d(cos theta) d(phi) d(psi), so even bins of the three
    have equal volume.
    """

    def __init__(self) -> None:
        self.directions = np.zeros((BANDS, TURNS), np.int64)
        """Rows per band (from z = -1 up) and sector (from the object's -x axis, about +z)."""
        self.rotations = np.zeros(_ROTATION, np.int64)

    def add(self, T: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """Count poses.

        Args:
            T: T_hand_object, shape [n, 4, 4].
            middle: The object's middle in its own frame [m], shape [3].

        Returns:
            The middle in the hand's base frame [m], shape [n, 3].
        """
        R = T[:, :3, :3]
        p_base = T[:, :3, 3] + R @ middle
        way = -np.einsum("nij,ni->nj", R, p_base)  # object frame
        way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        _count(self.directions, [(way[:, 2] + 1) / 2, _turn(way[:, 1], way[:, 0])])
        angles = [(R[:, 2, 2] + 1) / 2, _turn(R[:, 1, 2], R[:, 0, 2]), _turn(R[:, 2, 1], -R[:, 2, 0])]
        _count(self.rotations, angles)
        return p_base

    def numbers(self, poses: int) -> dict[str, Any]:
        """Bins hit, and the share that as many uniform draws as there are distinct ``poses`` would hit."""
        out = {}
        for name, counts in (("directions", self.directions), ("rotations", self.rotations)):
            uniform = 1 - (1 - 1 / counts.size) ** poses
            hit = int((counts > 0).sum())
            out[name] = {"bins": counts.size, "hit": hit, "share": hit / counts.size, "share_if_uniform": uniform}
        return out


def _turn(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Angle of (x, y) as a share of a turn from the -x axis, 0 to 1."""
    return (np.arctan2(y, x) + np.pi) / (2 * np.pi)


def _count(bins: np.ndarray, shares: list[np.ndarray]) -> None:
    """Add one to the bin of each row; a share runs from 0 to 1 along its axis."""
    index = [np.clip((s * n).astype(int), 0, n - 1) for s, n in zip(shares, bins.shape, strict=True)]
    np.add.at(bins, tuple(index), 1)

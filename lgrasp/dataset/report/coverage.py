"""How much a data set shows of the ways to hold an object, and how the joints of its postures vary together."""

from typing import Any, NamedTuple

import numpy as np


class Coverage:
    """Bins of approach directions and of rotations, each of equal solid angle or rotation volume.

    The approach direction points from the object's middle to the origin of the hand's base, in the object's frame:
    where the hand stands around the object. Bands of equal height and equal sectors of the unit sphere have equal area.
    A rotation Rz(phi) Ry(theta) Rz(psi) has the uniform measure d(cos theta) d(phi) d(psi), so even bins of the three
    have equal volume.
    """

    def __init__(self) -> None:
        self.directions = np.zeros((12, 24), np.int64)
        """Rows per band (from z = -1 up) and sector (from the object's -x axis, about +z)."""
        self.rotations = np.zeros((6, 12, 12), np.int64)
        """Rows per bin of cos(theta), phi, psi."""

    def add(self, T: np.ndarray, middle: np.ndarray) -> np.ndarray:
        """Count poses T_hand_object [n, 4, 4] of an object with its middle [3] in its own frame [m]; gives the middles
        in the hand's base frame [m], shape [n, 3]."""
        R = T[:, :3, :3]
        p_base = T[:, :3, 3] + R @ middle
        way = -np.einsum("nij,ni->nj", R, p_base)  # object frame
        way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
        _count(self.directions, (way[:, 2] + 1) / 2, _turn(way[:, 1], way[:, 0]))
        turns = _turn(R[:, 1, 2], R[:, 0, 2]), _turn(R[:, 2, 1], -R[:, 2, 0])
        _count(self.rotations, (R[:, 2, 2] + 1) / 2, *turns)
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


def _count(bins: np.ndarray, *shares: np.ndarray) -> None:
    """Add one to the bin of each row; a share runs from 0 to 1 along its axis."""
    index = [np.clip((s * n).astype(int), 0, n - 1) for s, n in zip(shares, bins.shape, strict=True)]
    np.add.at(bins, tuple(index), 1)


class Posture(NamedTuple):
    """How the joints vary together."""

    mean: np.ndarray
    """Joint positions [rad or m], shape [K]."""
    components: np.ndarray
    """Unit directions in joint space, largest variance first, shape [K, K]."""
    share: np.ndarray
    """Share of the variance, shape [K]; zeros if nothing moves."""

    @property
    def dimension(self) -> float:
        """Effective dimension (sum v)^2 / sum v^2 of the variances v: K if all are the same, 1 if there is but one."""
        return float(1 / (self.share**2).sum()) if self.share.any() else 0.0

    def scores(self, q: np.ndarray) -> np.ndarray:
        """Coordinates along the first two components [rad], shape [n, 2]."""
        scores = (q - self.mean) @ self.components[:2].T
        return np.pad(scores, ((0, 0), (0, 2 - scores.shape[1])))

    def numbers(self) -> dict[str, Any]:
        """JSON-serialisable."""
        return {
            "explained_variance": self.share.tolist(),
            "effective_dimension": self.dimension,
            "components_for_95_percent": int((np.cumsum(self.share) < 0.95).sum()) + 1 if self.share.any() else 0,
        }


def principal_postures(rows: int, sum_q: np.ndarray, sum_qq: np.ndarray) -> Posture:
    """Components of rows of which only their number and the sums of q [K] and of q q^T [K, K] are known."""
    mean = sum_q / max(rows, 1)
    covariance = sum_qq / max(rows, 1) - np.outer(mean, mean)
    variance, vectors = np.linalg.eigh(covariance)
    variance = np.where(variance > 1e-12 * max(1.0, float(np.abs(covariance).max())), variance, 0.0)[::-1]
    components = vectors.T[::-1]
    signs = np.sign(components[np.arange(len(components)), np.abs(components).argmax(1)])  # else eigh decides
    return Posture(mean, components * signs[:, None], variance / variance.sum() if variance.any() else variance)

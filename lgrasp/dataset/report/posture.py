"""Principal components of a hand's joint positions."""

from typing import Any, NamedTuple

import numpy as np


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
    """Components of rows of which only sums are known.

    Args:
        rows: Their number.
        sum_q: Sum of q, shape [K].
        sum_qq: Sum of q q^T, shape [K, K].
    """
    mean = sum_q / max(rows, 1)
    covariance = sum_qq / max(rows, 1) - np.outer(mean, mean)
    variance, vectors = np.linalg.eigh(covariance)
    variance = np.where(variance > 1e-12 * max(1.0, float(np.abs(covariance).max())), variance, 0.0)[::-1]
    components = vectors.T[::-1]
    signs = np.sign(components[np.arange(len(components)), np.abs(components).argmax(1)])  # else eigh decides
    return Posture(mean, components * signs[:, None], variance / variance.sum() if variance.any() else variance)

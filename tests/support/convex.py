"""Distances of convex sets without GJK: a least-squares problem over convex weights."""

import numpy as np
from scipy.optimize import nnls

__all__ = ["hull_distance", "segment_distance"]


def hull_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Distance [m] of the convex hulls of points a (n, 3) and b (m, 3); 0 when they overlap.

    The least-norm point of hull(a - b) by non-negative least squares: with homogeneous weights,
    min |P w|^2 + (1 - sum w)^2 has its minimum along that point.
    """
    P = (a[:, None] - b[None]).reshape(-1, 3).T  # (3, n m)
    scale = np.abs(P).max()
    w, _ = nnls(np.vstack([P / scale, np.ones(P.shape[1])]), np.array([0, 0, 0, 1.0]), maxiter=50 * P.shape[1])
    return float(np.linalg.norm(P @ w / w.sum()))


def segment_distance(p: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Distance [m] of points p (n, 3) to the segment a-b."""
    ab = b - a
    t = np.clip((p - a) @ ab / max(float(ab @ ab), 1e-30), 0, 1)
    return np.linalg.norm(p - a - t[:, None] * ab, axis=1)

"""Octahedral map of the unit sphere and its bins."""

import numpy as np

__all__ = ["decode", "normal_bin", "octahedral"]


_TURN = np.array([[-0.66, -0.54, 0.52], [0.69, -0.71, 0.14], [0.29, 0.45, 0.84]])


def octahedral(n: np.ndarray) -> np.ndarray:
    """Points (k, 2) of the square [-1, 1]^2 of unit vectors n (k, 3)."""
    e = n[:, :2] / np.abs(n).sum(1, keepdims=True)
    folded = (1 - np.abs(e[:, ::-1])) * np.where(e >= 0, 1.0, -1.0)
    return np.where(n[:, 2:] < 0, folded, e)


def normal_bin(n: np.ndarray, res: int = 8) -> np.ndarray:
    """Bin index (k,) of unit vectors."""
    i = np.clip(((octahedral(n @ _TURN.T) + 1) / 2 * res).astype(int), 0, res - 1)
    return i[:, 0] * res + i[:, 1]


def decode(code: np.ndarray) -> np.ndarray:
    """Unit vectors (k, 3) of 8 + 8 bit codes."""
    code = np.asarray(code).astype(int)
    e = np.stack([code // 256, code % 256], 1) / 127.5 - 1
    z = 1 - np.abs(e).sum(1)
    folded = (1 - np.abs(e[:, ::-1])) * np.where(e >= 0, 1.0, -1.0)
    n = np.column_stack([np.where(z[:, None] < 0, folded, e), z])
    return n / np.linalg.norm(n, axis=1, keepdims=True)

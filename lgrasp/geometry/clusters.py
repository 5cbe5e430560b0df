"""Spatially compact groups of points with bounding spheres."""

import numpy as np

CLUSTER_SIZE = 32
_BALL_STEPS = 64  # towards the farthest point; a radius is within 1/64 of the smallest


def cluster_order(points: np.ndarray, *, size: int = CLUSTER_SIZE) -> np.ndarray:
    """Order that makes every run of ``size`` points compact: recursive median split of the longest axis.

    Args:
        points: Points [m], shape (n, 3); all runs but the last are full.
        size: Points of a run.

    Returns:
        Permutation, shape (n,), int64; consecutive clusters are near each other as well.
    """
    runs: list[np.ndarray] = []
    stack = [np.arange(len(points))]
    while stack:
        index = stack.pop()
        if len(index) <= size:
            runs.append(index)
            continue
        axis = int(np.argmax(np.ptp(points[index], axis=0)))
        half = (len(index) // size + 1) // 2 * size
        index = index[np.argsort(points[index, axis], kind="stable")]
        stack += [index[half:], index[:half]]
    return np.concatenate(runs)


def cells(points: np.ndarray, size: float) -> np.ndarray:
    """Number of the cell that each of the points (..., 3) is in, of a grid with edges of ``size`` [m]; int64.

    Cells up to a million from the origin have numbers of their own.
    """
    x, y, z = np.moveaxis(np.floor(points / size).astype(np.int64), -1, 0)
    return (x << 42) + (y << 21) + z


def one_per_cell(points: np.ndarray, size: float) -> np.ndarray:
    """Indices, ascending, of the first of the points (n, 3) in each cell of a grid with edges of ``size`` [m]."""
    return np.sort(np.unique(cells(points, size), return_index=True)[1])


def evenly(points: np.ndarray, count: int) -> np.ndarray:
    """``count`` of the points (n, 3), evenly out of their order; repeated where there are not so many."""
    return points[((np.arange(count) + 0.5) * len(points) / count).astype(int)]


def bounding_spheres(points: np.ndarray, *, size: int = CLUSTER_SIZE) -> tuple[np.ndarray, np.ndarray]:
    """Nearly smallest balls around runs of ``size`` points (Bădoiu–Clarkson core-set iteration).

    Args:
        points: Points [m], shape (n, 3); the last run may be shorter.
        size: Points of a run.

    Returns:
        Centres [m], shape (k, 3), and radii [m], shape (k,), of the k = ceil(n / size) runs, f32, rounded up.
    """
    full = np.pad(np.asarray(points, np.float64), ((0, -len(points) % size), (0, 0)), mode="edge")
    group = full.reshape(-1, size, 3)  # (k, c, 3)
    x, y, z = np.moveaxis(group, 2, 0).copy()  # axis by axis it takes a third of the time
    center = group.mean(axis=1)
    row = np.arange(len(group))
    for step in range(1, _BALL_STEPS + 1):
        cx, cy, cz = center.T[:, :, None]
        far = np.argmax((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2, axis=1)
        center += (group[row, far] - center) / (step + 1)
    center = center.astype(np.float32)
    radius = np.linalg.norm(group - center[:, None].astype(np.float64), axis=-1).max(axis=1)
    return center, np.nextafter(radius.astype(np.float32) + np.float32(1e-7), np.float32(np.inf))

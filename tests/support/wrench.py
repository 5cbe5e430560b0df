"""Wrench problems solved exactly: least-norm residuals by non-negative least squares, epsilon by a 6-D convex hull."""

import numpy as np
from scipy.optimize import linprog, nnls
from scipy.spatial import ConvexHull, QhullError

__all__ = ["cone_forces", "epsilon", "is_balanced", "residual", "unresisted", "wrenches"]


def cone_forces(normals: np.ndarray, mu: float, edges: int) -> np.ndarray:
    """Edges (k, max(edges, 1), 3) of the friction cones, unit normal part; mu = 0 gives the normals.

    The first edge points along normalize(n x e), e the axis of n's smallest component.
    """
    if mu == 0.0:
        return normals[:, None]
    t = np.cross(normals, np.eye(3)[np.abs(normals).argmin(1)])
    t /= np.linalg.norm(t, axis=1, keepdims=True)
    b = np.cross(normals, t)
    angle = 2 * np.pi * np.arange(edges) / edges
    around = np.cos(angle)[:, None] * t[:, None] + np.sin(angle)[:, None] * b[:, None]  # (k, edges, 3)
    return normals[:, None] + mu * around


def wrenches(arms: np.ndarray, forces: np.ndarray, scale: float) -> np.ndarray:
    """Wrenches (k * e, 6) (f, scale * arm x f) of forces (k, e, 3) at arms (k, 3)."""
    return np.concatenate([forces, scale * np.cross(arms[:, None], forces)], -1).reshape(-1, 6)


def residual(arms: np.ndarray, normals: np.ndarray, mu: float, edges: int, scale: float) -> float:
    """Least norm of a convex combination of the cone edges' wrenches.

    Homogeneous weights: min |W w|^2 + (1 - sum w)^2 over w >= 0 has its minimum along the least-norm combination.
    """
    W = wrenches(arms, cone_forces(normals, mu, edges), scale).T
    w, _ = nnls(np.vstack([W, np.ones(W.shape[1])]), np.append(np.zeros(6), 1.0), maxiter=100 * W.shape[1])
    x = W @ w / w.sum()
    # certified: no wrench lies farther towards the origin than the answer
    assert (W.T @ x).min() > x @ x - 1e-7
    return float(np.linalg.norm(x))


def is_balanced(arms: np.ndarray, normals: np.ndarray, mu: float, edges: int, scale: float) -> bool:
    """Does some convex combination of the wrenches vanish? A linear program."""
    W = wrenches(arms, cone_forces(normals, mu, edges), scale).T
    A = np.vstack([W, np.ones(W.shape[1])])
    return linprog(np.zeros(W.shape[1]), A_eq=A, b_eq=np.append(np.zeros(6), 1.0), bounds=(0, None)).status == 0


def epsilon(arms: np.ndarray, normals: np.ndarray, mu: float, radius: float) -> float:
    """Ferrari-Canny epsilon of the 8-edge cones (L1 hull), torque / radius; 0 when the origin is not inside."""
    W = wrenches(arms, cone_forces(normals, mu, 8), 1 / radius)
    try:
        hull = ConvexHull(W)
    except QhullError:
        return 0.0
    return max(0.0, float(-hull.equations[:, 6].max()))


def unresisted(arms: np.ndarray, normals: np.ndarray, mu: float, loads: np.ndarray, edges: int = 96) -> float:
    """Largest over loads (m, 3) of the least norm of (load, 0) plus wrenches, torque / 5 cm, sum of normal forces <= 5.

    Cones of many edges stand for round ones. The bound is an equality with a slack, weighted heavily.
    """
    W = wrenches(arms, cone_forces(normals, mu, edges), 20.0).T
    heavy = 1e3
    A = np.vstack([np.column_stack([W, np.zeros(6)]), np.full(W.shape[1] + 1, heavy)])
    worst = 0.0
    for load in loads:
        w, _ = nnls(A, np.concatenate([-load, np.zeros(3), [5.0 * heavy]]), maxiter=100 * A.shape[1])
        worst = max(worst, float(np.linalg.norm(W @ w[:-1] + np.append(load, np.zeros(3)))))
    return worst

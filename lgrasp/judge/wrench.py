"""Wrenches of contact forces: the least residual, the largest wrench resisted."""

import math

import numpy as np
from scipy.optimize import nnls
from scipy.spatial import ConvexHull, QhullError

from lgrasp.judge.bounds import CONE_EDGES, MU, TORQUE_SCALE


def cone_forces(inward: np.ndarray, mu: float = MU) -> np.ndarray:
    """Edges of the friction pyramids about inward normals (C, 3), normal part 1: (C, CONE_EDGES, 3)."""
    t1 = np.cross(inward, np.eye(3)[np.abs(inward).argmin(axis=1)])
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    t2 = np.cross(inward, t1)
    angle = np.arange(CONE_EDGES) * 2.0 * math.pi / CONE_EDGES
    side = np.cos(angle)[:, None] * t1[:, None] + np.sin(angle)[:, None] * t2[:, None]
    return inward[:, None] + mu * side


def wrench_residual(points: np.ndarray, inward: np.ndarray, mu: float = MU) -> tuple[float, float]:
    """Least norm of the summed wrench, sum of normal forces 1, and the optimality gap; mu 0 is frictionless.

    min |s G y|^2 + (s - 1)^2 over y in the simplex and s >= 0 is a non-negative least squares in x = s y whose y is the
    minimiser for every s > 0, so the exact active-set solver gives the exact answer. The gap |w|^2 - min_j g_j.w bounds
    |w|^2 from its optimum and is 0 at the optimum.
    """
    forces = cone_forces(inward, mu) if mu > 0 else inward[:, None]
    arms = np.repeat(points - points.mean(axis=0), forces.shape[1], axis=0)
    f = forces.reshape(-1, 3)
    G = np.vstack([f.T, TORQUE_SCALE * np.cross(arms, f).T])
    x, _ = nnls(np.vstack([G, np.ones((1, len(f)))]), np.append(np.zeros(6), 1.0), maxiter=50 * len(f))
    w = G @ (x / x.sum())
    return float(np.linalg.norm(w)), float(w @ w - (G.T @ w).min())


def force_errors(
    points: np.ndarray, inward: np.ndarray, forces: np.ndarray, mu: float = MU
) -> tuple[float, float, float]:
    """Of stored forces (C, 3): norm of the wrench, error of the normal parts' sum from 1, excess over the cone."""
    torque = TORQUE_SCALE * np.cross(points - points.mean(axis=0), forces).sum(axis=0)
    push = (forces * inward).sum(axis=1)
    side = np.linalg.norm(forces - push[:, None] * inward, axis=1)
    balance = float(np.linalg.norm(np.append(forces.sum(axis=0), torque)))
    return balance, abs(float(push.sum()) - 1.0), float((side - mu * push).max())


def ferrari_canny(points: np.ndarray, inward: np.ndarray, centre: np.ndarray, radius: float, mu: float = MU) -> float:
    """Radius of the largest origin ball in the hull of the cone edges' wrenches (L1), 0 without force closure."""
    forces = cone_forces(inward, mu)
    arms = np.repeat(points - centre, CONE_EDGES, axis=0)
    f = forces.reshape(-1, 3)
    try:
        hull = ConvexHull(np.hstack([f, np.cross(arms, f) / radius]))
    except QhullError:
        return 0.0
    return max(0.0, float(-hull.equations[:, -1].max()))

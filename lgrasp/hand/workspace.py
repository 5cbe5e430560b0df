"""Where the fingers of a hand can touch something, and how well they move there, by random postures."""

from dataclasses import dataclass

import numpy as np

from lgrasp.geometry.clusters import cells
from lgrasp.geometry.poses import device_rotation
from lgrasp.hand.arrays import body_poses, upload_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.surface_visibility import last_bodies

WORKSPACE_VERSION = 1
"""Raised whenever the numbers of a hand change."""

_POSTURES = 4096
_CELL = 0.01  # [m]
_POINTS = 64  # of a finger's contact surface
_JACOBIANS = 256  # postures
_STEP = 0.01  # [rad or m] of the differences


@dataclass(frozen=True)
class Workspace:
    """Of a hand with G fingers (dependency groups)."""

    volume: float
    """Of the cells of 1 cm that the contact surface of a finger reaches, at postures at which it is clear of the base
    and of itself [m^3]."""
    shared: float
    """Of those that two fingers or more reach [m^3]."""
    manipulability: float
    """Yoshikawa's sqrt(det(J J^T)) of the last links' contact surface, J its translation by the joints, mean of the
    fingers [m^3/rad^3]; 0 of fingers that move it in a plane."""


def measure_workspace(model: HandModel) -> Workspace:
    """The workspace of a hand, from 4096 random postures."""
    postures = sample_bodies(model, model.random_postures(_POSTURES))
    reached = []
    for group in range(model.groups):
        first, end = model.contact_first[group : group + 2]
        rows = np.unique(np.linspace(first, end - 1, _POINTS).astype(int)) if end > first else np.zeros(0, int)
        clear = np.flatnonzero(postures.clear[:, group])
        points = postures.place(clear[:, None], model.contact_body[None, rows], model.contact_points[None, rows])
        reached.append(np.unique(cells(points, _CELL)))
    times = np.unique(np.concatenate(reached), return_counts=True)[1]
    return Workspace(len(times) * _CELL**3, int((times > 1).sum()) * _CELL**3, _manipulability(model))


def _manipulability(model: HandModel) -> float:
    """Mean over the last bodies of fingers that may touch."""
    tips = {}
    for body in sorted(last_bodies(model)):
        points = model.contact_points[model.contact_body == body]
        if len(points):
            tips[body] = points.mean(0)
    if not tips:
        return 0.0
    q, k = model.random_postures(_JACOBIANS, seed=1), model.dofs
    steps = _STEP * np.concatenate([np.eye(k), -np.eye(k)])
    poses = body_poses(upload_hand(model, "cpu"), (q[:, None] + steps).reshape(-1, k))
    poses = poses.reshape(len(q), 2 * k, -1, 7).astype(float)
    found = []
    for body, point in tips.items():
        own = poses[:, :, body]
        placed = device_rotation(own.reshape(-1, 7)).apply(point).reshape(*own.shape[:2], 3) + own[..., :3]
        J = (placed[:, :k] - placed[:, k:]).transpose(0, 2, 1) / (2 * _STEP)  # (n, 3, K)
        found.append(np.sqrt(np.maximum(np.linalg.det(J @ J.transpose(0, 2, 1)), 0.0)).mean())
    return float(np.mean(found))

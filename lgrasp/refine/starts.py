"""Where a local search begins: an open hand before points of the surface, its palm facing them."""

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.errors import HandError
from lgrasp.hand.model import HandModel
from lgrasp.refine.surface import farthest_points

__all__ = ["STAND_OFF", "palm_axis", "start_poses"]

STAND_OFF = 0.12
"""Distance of a hand's base from the surface where hand.yaml has no ``stand_off`` [m]."""

_TURN = np.pi * (3 - np.sqrt(5))  # golden angle: rolls of consecutive starts are spread evenly


def palm_axis(model: HandModel) -> tuple[np.ndarray, np.ndarray]:
    """Centre of the palm's contact surface (3,) [m] and the unit direction it faces (3,), base frame.

    Raises:
        HandError: the hand has no palm.
    """
    first, end = model.contact_first[-2:]
    if first == end:
        raise HandError(f"hand '{model.name}' has no palm (hand.yaml: palm), so no side of it can face an object")
    facing = model.contact_normals[first:end].mean(0)
    return model.contact_points[first:end].mean(0), facing / np.linalg.norm(facing)


def start_poses(
    model: HandModel, points: np.ndarray, normals: np.ndarray, count: int, stand_off: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (N, 3, 3), positions (N, 3) [m] of open hands in the frame of the points, and the chosen points (N,).

    The points are the farthest from each other; the palm faces along minus the normal, the line from its centre meets
    the point, and the base stands ``stand_off`` from it along that line. The roll about it turns by the golden angle
    from start to start.

    Args:
        points: (n, 3) [m]. normals: outward, (n, 3). count: N, with repeats (at other rolls) when there are fewer.
    """
    chosen = farthest_points(points, count)
    centre, facing = palm_axis(model)
    before = -normals[chosen]
    side = np.cross(before, np.eye(3)[np.abs(before).argmin(1)])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    to = np.stack([side, np.cross(before, side), before], -1)  # columns
    own = np.cross(facing, np.eye(3)[np.abs(facing).argmin()])
    own /= np.linalg.norm(own)
    of = np.stack([own, np.cross(facing, own), facing], -1)
    roll = Rotation.from_rotvec(np.arange(count)[:, None] * _TURN * np.array([0, 0, 1.0])).as_matrix()
    R = to @ roll @ of.T
    lateral = centre - (centre @ facing) * facing
    t = points[chosen] - stand_off * before - np.einsum("nij,j->ni", R, lateral)
    return R, t, chosen

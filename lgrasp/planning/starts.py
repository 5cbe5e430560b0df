"""Where a local search begins: an open hand before points of the surface, its palm facing them."""

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.geometry.poses import device_pose, shortest_rotation
from lgrasp.hand.contact_surface import palm_axis
from lgrasp.hand.model import HandModel

STAND_OFF = 0.12
"""Distance of a hand's base from the surface where hand.yaml has no ``stand_off`` [m]."""

GOLDEN_ANGLE = float(np.pi * (3 - np.sqrt(5)))
"""Multiples of it are spread evenly over the circle [rad]."""


def start_poses(
    model: HandModel, points: np.ndarray, normals: np.ndarray, turn: np.ndarray, stand_off: float
) -> np.ndarray:
    """Bases of hands in the frame of the points, device poses (N, 7).

    The palm faces along minus the normal, the line from its centre meets the point, and the base stands ``stand_off``
    from it along that line.

    Args:
        points: (N, 3) [m]. normals: outward, (N, 3). turn: roll about the line [rad], (N,).
    """
    centre, facing = palm_axis(model)
    roll = Rotation.from_rotvec(turn[:, None] * np.array([0, 0, 1.0]))
    R = shortest_rotation(-normals) * roll * shortest_rotation(facing[None]).inv()
    lateral = centre - (centre @ facing) * facing
    return device_pose(points + stand_off * normals - R.apply(lateral), R)


def tilted(normals: np.ndarray, angle: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) turned away by angle (N,) [rad], towards the side at azimuth (N,) [rad]."""
    side = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], 1)
    return shortest_rotation(normals).apply(side)

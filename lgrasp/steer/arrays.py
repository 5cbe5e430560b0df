"""A steering on a device, as kernels of the stages read it."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from lgrasp.geometry.poses import internal_poses
from lgrasp.hand.arrays import HandArrays
from lgrasp.hand.contact_surface import palm_axis
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct
from lgrasp.steer.params import NOTHING, Steering
from lgrasp.steer.poses import read_poses
from lgrasp.steer.touch import Touching, describe_touching, find_touching

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Steer:
    """What is asked of grasps."""

    groups: wp.int32  # bit g: group g may touch
    palm_points: wp.array(dtype=wp.int32)  # (P,) contact points of the palm that may touch
    facing: wp.vec3  # unit vector that the palm faces along, base frame
    approach: wp.vec3  # unit axis of the cone in which it must be, object's frame
    cosine: wp.float32  # of the cone's half angle; below -1: any direction
    poses: wp.array(dtype=wp.transform)  # (T,) T_hand_object of the internal frame that candidates take; none: drawn


@dataclass(frozen=True, eq=False)
class SteerArrays:
    """A steering of one hand and its copy on one device."""

    touching: Touching
    struct: "Steer"
    poses: np.ndarray | None = None
    """T_hand_object that are asked for, x y z [m] qw qx qy qz, shape (T, 7)."""
    told: dict[str, Any] = field(default_factory=dict)
    """What is asked in the words of the hand (:func:`~lgrasp.steer.touch.describe_touching`); empty if nothing is."""

    @property
    def fingers(self) -> int:
        """Fingers that may touch."""
        return int(self.touching.groups.sum())

    @property
    def least(self) -> int:
        """Fewest finger contacts of a grasp that are asked for."""
        return self.fingers if self.touching.exact else 0


def upload_steering(
    steering: Steering, touching: Touching, hand: HandArrays, center: np.ndarray | None = None
) -> SteerArrays:
    """Put a steering on the device of its hand.

    Args:
        touching: what it says of this hand.
        center: origin of the object's internal frame in the user's [m], (3,).

    Raises:
        ConfigError: poses that cannot be read.
        HandError: an approach is asked for, and the hand has no side to face an object with.
    """
    palm = np.arange(*hand.model.contact_first[-2:])
    values = {"groups": touching.bits, "palm_points": palm[touching.points[palm]].astype(np.int32), "cosine": -2.0}
    if steering.approach:
        direction = np.array(steering.approach.direction) / np.linalg.norm(steering.approach.direction)
        values |= {"facing": palm_axis(hand.model)[1], "approach": direction}
        values["cosine"] = float(np.cos(np.radians(steering.approach.angle)))
    poses = read_poses(steering.pose) if steering.pose else None
    if poses is not None:
        values["poses"] = internal_poses(poses, np.zeros(3) if center is None else center)
    told = describe_touching(steering, touching, hand.model, poses) if steering.asks else {}
    return SteerArrays(touching, upload_struct(Steer, hand.device, values), poses, told)


def steer_nothing(hand: HandArrays) -> SteerArrays:
    """Everything of a hand may touch."""
    return upload_steering(NOTHING, find_touching(NOTHING, hand.model, {}), hand)


@wp.func
def may_touch(groups: wp.int32, g: wp.int32):
    """True if group g may touch, by the bits ``groups``."""
    return ((groups >> g) & 1) == 1


@wp.func
def pick_group(groups: wp.int32, u: wp.float32):
    """One of the groups that may touch, u in [0, 1)."""
    n = int(0)
    bits = groups
    while bits != 0:
        n += bits & 1
        bits = bits >> 1
    skip = wp.min(int(u * float(n)), n - 1)
    g = int(0)
    while skip > 0 or not may_touch(groups, g):
        if may_touch(groups, g):
            skip -= 1
        g += 1
    return g

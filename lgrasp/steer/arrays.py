"""A steering on a device, as kernels of the stages read it."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.hand.arrays import HandArrays
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct
from lgrasp.steer.params import Steering
from lgrasp.steer.touch import Touching, find_touching

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Steer:
    """What is asked of grasps."""

    groups: wp.int32  # bit g: group g may touch
    palm_points: wp.array(dtype=wp.int32)  # (P,) contact points of the palm that may touch


@dataclass(frozen=True, eq=False)
class SteerArrays:
    """A steering of one hand and its copy on one device."""

    touching: Touching
    struct: "Steer"

    @property
    def fingers(self) -> int:
        """Fingers that may touch."""
        return int(self.touching.groups.sum())

    @property
    def least(self) -> int:
        """Fewest finger contacts of a grasp that are asked for."""
        return self.fingers if self.touching.exact else 0


def upload_steering(touching: Touching, hand: HandArrays) -> SteerArrays:
    """Put a steering on the device of its hand."""
    model = hand.model
    palm = np.arange(*model.contact_first[-2:])
    values = {"groups": touching.bits, "palm_points": palm[touching.points[palm]].astype(np.int32)}
    return SteerArrays(touching, upload_struct(Steer, hand.device, values))


def steer_nothing(hand: HandArrays) -> SteerArrays:
    """Everything of a hand may touch."""
    return upload_steering(find_touching(Steering(), hand.model, {}), hand)


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

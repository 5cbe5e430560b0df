"""Structs and codes of the place stage."""

from enum import IntEnum

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import params_struct
from lgrasp.stages.place.params import PlaceParams

wp.set_module_options(KERNEL_OPTIONS)


class PlaceCount(IntEnum):
    """Counts of the stage."""

    TRIED = 0
    BLOCKED = 1
    KEPT = 2


class Rating(IntEnum):
    """Ratings that are no number of opposed contacts."""

    HOPELESS = 0  # the hand can hold nothing there
    CLEAR = 1  # of static links; not rated further, or one opposed pair
    BLOCKED = -1  # by static links, or these by the table


PlaceValues = params_struct(
    "PlaceValues", __name__, PlaceParams, floats="allowed_penetration min_object_distance min_table_distance"
)
"""PlaceParams and GraspBounds as kernels read them; ``canonical``, ``pinch``, ``palm`` are shares of all proposals."""


@wp.struct
class ProposedPoses:
    """B proposals for each of N candidates."""

    pose: wp.array2d(dtype=wp.transform)  # (N, B) T_hand_object of the internal frame [m]
    palm_point: wp.array2d(dtype=wp.int32)  # (N, B) hand contact point on ``surface``, -1 none
    surface: wp.array2d(dtype=wp.int32)  # (N, B) object contact point that placed it
    setting: wp.array2d(dtype=wp.int32)  # (N, B) setting of the hand's shared joints
    resting: wp.array2d(dtype=wp.int32)  # (N, B) resting pose of the object, -1 none
    anchor: wp.array3d(dtype=wp.int32)  # (N, B, G) object contact point that the group can touch, -1 unknown
    rating: wp.array2d(dtype=wp.int32)  # (N, B) opposed pairs of contacts, or a Rating

"""Structs and codes of the place stage."""

from enum import IntEnum

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

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


@wp.struct
class PlaceValues:
    """PlaceParams and GraspBounds as kernels read them."""

    canonical: wp.float32  # share of all proposals, as the next two
    pinch: wp.float32
    palm: wp.float32
    samples: wp.int32
    policy_temperature: wp.float32
    max_com_distance: wp.float32  # [m]
    allowed_penetration: wp.float32  # [m]
    spins: wp.int32
    min_object_distance: wp.float32  # [m]
    min_table_distance: wp.float32  # [m]


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

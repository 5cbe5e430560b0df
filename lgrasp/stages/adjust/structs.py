"""Structs of the adjust stage."""

from enum import IntEnum

import warp as wp

from lgrasp.runtime.structs import params_struct
from lgrasp.stages.adjust.params import AdjustParams


class Progress(IntEnum):
    """What has become of a set."""

    GOING = 0
    WHOLE = 1  # every contact is made, nothing sinks in
    GIVEN_UP = -1


class AdjustCount(IntEnum):
    """Counts of the stage."""

    TRIED = 0
    KEPT = 1


AdjustValues = params_struct("AdjustValues", __name__, AdjustParams, floats="cosine max_penetration")
"""AdjustParams and GraspBounds as kernels read them; ``cosine``: least of the normals; ``object_turn`` is in [rad]."""


@wp.struct
class Deepest:
    """Where a body and the object meet deepest."""

    at: wp.vec3  # [m] object's frame
    away: wp.vec3  # unit vector in which the body leaves the object
    depth: wp.float32  # [m]


@wp.struct
class FaceContact:
    """A contact of a finger: where it is, and how far from being made."""

    local: wp.vec3  # [m] point of the link, body frame
    out: wp.vec3  # outward normal there
    gap: wp.float32  # [m] of the link's surface to the object's point
    beside: wp.int32  # 1: the object's point lies beside the face of the link that is to touch


@wp.struct
class Adjusted:
    """S sets on their way; B bodies, the base first, each looked at in K slices."""

    progress: wp.array(dtype=wp.int32)  # (S,) Progress
    both: wp.array(dtype=wp.int32)  # (S,) 1: penetration is looked at both ways
    touch: wp.array2d(dtype=FaceContact)  # (S, G + 1) contact of each group, the palm's last
    deepest: wp.array3d(dtype=Deepest)  # (S, B, K) of bodies whose fingers touch, and of the base

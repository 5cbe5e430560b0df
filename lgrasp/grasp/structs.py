"""The tables that flow between stages as kernels read and write them (names and meaning as in ``tables``)."""

from enum import IntEnum

import warp as wp

from lgrasp.math.kinematics import vec_dof

FURTHER = wp.constant(2)
"""Most further contacts of a candidate: those of other links of its finger."""
vec_further = wp.types.vector(2 * int(FURTHER), wp.int32)
"""Contact points of the object, -1 none, then those of the hand that stand for the links."""


class State(IntEnum):
    """What is known of a candidate."""

    DRAWN = 0  # its posture is the seed from the contact field
    REALISED = 1  # its posture makes the contact
    MISSED = -1  # no posture was found that makes it
    BLOCKED = -2  # the finger that makes it meets something


@wp.struct
class Poses:
    """P object poses in the hand base frame, of which the first ``rows`` are in use; G groups."""

    index: wp.array(dtype=wp.int32)  # (P,) candidate of the shard's stream
    pose: wp.array(dtype=wp.transform)  # (P,) T_hand_object of the internal frame [m]
    palm_point: wp.array(dtype=wp.int32)  # (P,) hand contact point that touches, -1 none
    palm_surface: wp.array(dtype=wp.int32)  # (P,) object contact point that touches, -1 none
    setting: wp.array(dtype=wp.int32)  # (P,) setting of the hand's shared joints
    resting: wp.array(dtype=wp.int32)  # (P,) resting pose of the object, -1 none
    anchor: wp.array2d(dtype=wp.int32)  # (P, G) object contact point about which the group can touch, -1 unknown
    rows: wp.array(dtype=wp.int32)  # (1,) rows in use


@wp.struct
class Candidates:
    """Up to M contacts of each of G groups at each of P poses."""

    poses: Poses
    count: wp.array2d(dtype=wp.int32)  # (P, G) candidates drawn
    surface: wp.array3d(dtype=wp.int32)  # (P, G, M) object contact point
    record: wp.array3d(dtype=wp.int32)  # (P, G, M) contact vector of the field
    state: wp.array3d(dtype=wp.int32)  # (P, G, M) State
    q: wp.array3d(dtype=vec_dof)  # (P, G, M) joint seed or realised posture [rad or m]
    further: wp.array3d(dtype=vec_further)  # (P, G, M) contacts of other links; or (0, 0, 0)


@wp.func
def further_contacts(candidates: Candidates, row: wp.int32, g: wp.int32, m: wp.int32):
    """How many further contacts a candidate has."""
    n = int(0)
    if candidates.further.shape[2] > 0:
        for k in range(FURTHER):
            if candidates.further[row, g, m][k] >= 0:
                n += 1
    return n


@wp.struct
class Sets:
    """S sets of contacts, of which the first ``rows`` are in use."""

    pose: wp.array(dtype=wp.int32)  # (S,) row of the poses
    slot: wp.array(dtype=wp.int32)  # (S,) number of the set within its pose
    chosen: wp.array2d(dtype=wp.int32)  # (S, G) candidate of each group, -1 unused
    score: wp.array(dtype=wp.float32)  # (S,) norm of the residual wrench
    rows: wp.array(dtype=wp.int32)  # (1,) rows in use

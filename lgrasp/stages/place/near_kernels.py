"""Kernels of the place stage that propose poses near others."""

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.structs import Poses
from lgrasp.hand.arrays import Hand
from lgrasp.math.limits import MAX_GROUPS
from lgrasp.math.transforms import rotation_between
from lgrasp.object.arrays import Object
from lgrasp.policy.arrays import Network
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.kernels import SEED_STRIDE, no_proposal, rate_there
from lgrasp.stages.place.structs import PlaceValues, ProposedPoses
from lgrasp.steer.arrays import Steer
from lgrasp.steer.cone import in_cone

wp.set_module_options(KERNEL_OPTIONS)

_DRAWS = wp.constant(256)  # of points, until one is near another
_AROUND = wp.constant(128.0)  # places before and after a point in the object's order, which has most that are near


@wp.struct
class NearMoves:
    """Which poses are moved, and how far."""

    parent: wp.array(dtype=wp.int32)  # (N,) row of the pose that is moved
    number: wp.array(dtype=wp.int32)  # (N,) of the new pose, which decides how it is moved
    distance: wp.float32  # [m] most, along the object and along the palm
    angle: wp.float32  # [rad] standard deviation, about the palm's normal


@wp.func
def _near_on_object(obj: Object, k: wp.int32, distance: wp.float32, state: wp.uint32):
    """A contact point of the object within a distance of point k, or k itself."""
    for _t in range(_DRAWS):
        j = wp.clamp(k + int((2.0 * wp.randf(state) - 1.0) * _AROUND), 0, obj.contacts - 1)
        if wp.length_sq(obj.contact_points[j] - obj.contact_points[k]) < distance * distance:
            return j
    return k


@wp.func
def _near_on_palm(hand: Hand, steer: Steer, k: wp.int32, distance: wp.float32, state: wp.uint32):
    """A contact point of the palm that may touch within a distance of point k, or k itself."""
    palms = steer.palm_points.shape[0]
    for _t in range(_DRAWS):
        j = steer.palm_points[wp.min(int(wp.randf(state) * float(palms)), palms - 1)]
        if wp.length_sq(hand.contacts.points[j] - hand.contacts.points[k]) < distance * distance:
            return j
    return k


@wp.kernel
def propose_near(
    hand: Hand,
    field: Field,
    obj: Object,
    params: PlaceValues,
    steer: Steer,
    policy: Network,
    poses: Poses,
    moves: NearMoves,
    seed: wp.array(dtype=wp.int32),
    proposals_out: ProposedPoses,
):
    """One of several poses near another, and its rating.

    The object stays on the palm: a point near the one that touched, at a point of the palm near that one, turned as
    little as their normals ask for and by a random angle about them.

    Args:
        poses: of objects on the palm.
        seed: of the stage and its moves, (1,).
    """
    row, b = wp.tid()
    parent = moves.parent[row]
    state = wp.rand_init(seed[0] + b * SEED_STRIDE, moves.number[row])
    i = _near_on_object(obj, poses.palm_surface[parent], moves.distance, wp.rand_init(wp.randi(state)))
    palm = _near_on_palm(hand, steer, poses.palm_point[parent], moves.distance, wp.rand_init(wp.randi(state)))
    n = hand.contacts.normals[palm]
    R = wp.transform_get_rotation(poses.pose[parent])
    R = rotation_between(wp.quat_rotate(R, obj.contact_normals[i]), -n) * R
    R = wp.quat_from_axis_angle(n, moves.angle * wp.randn(state)) * R
    T = wp.transform(hand.contacts.points[palm] - wp.quat_rotate(R, obj.contact_points[i]), R)
    resting = poses.resting[parent]
    setting = poses.setting[parent]
    anchor = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.int32)
    for g in range(hand.kin.groups):
        anchor[g] = -1
    no_proposal(proposals_out, row, b)
    proposals_out.pose[row, b] = T
    proposals_out.palm_point[row, b] = palm
    proposals_out.surface[row, b] = i
    proposals_out.setting[row, b] = setting
    proposals_out.resting[row, b] = resting
    if in_cone(steer, R):
        proposals_out.rating[row, b] = rate_there(
            hand, field, obj, params, policy, steer.groups, T, resting, setting, palm, anchor, state
        )


@wp.kernel
def number_poses(moves: NearMoves, poses_out: Poses):
    """Numbers of new poses in place of the rows that they were proposed in."""
    i = wp.tid()
    if i < poses_out.rows[0]:
        poses_out.index[i] = moves.number[poses_out.index[i]]

"""Kernels that move the object a little from where it was."""

import warp as wp

from lgrasp.grasp.collision import body_clear
from lgrasp.grasp.structs import Poses
from lgrasp.hand.arrays import Hand
from lgrasp.math.transforms import rotation_between
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.structs import ProposedPoses, Rating
from lgrasp.steer.arrays import Steer

wp.set_module_options(KERNEL_OPTIONS)

_SAME_SIDE = wp.constant(0.7)  # cosine of normals of the object, so that a point is not across a thin wall


@wp.struct
class MoveValues:
    """How far the object moves."""

    reach: wp.float32  # [m] between the old contact of the palm and the new one, on each surface
    angle: wp.float32  # [rad] of the roll, either way
    allowed_penetration: wp.float32  # [m]


@wp.func
def _surface_near(obj: Object, i: wp.int32, reach: wp.float32, state: wp.uint32):
    """A contact point of the object within reach of another, on the same side."""
    chosen = i
    n = float(0.0)
    for k in range(obj.contacts):
        near = wp.length(obj.contact_points[k] - obj.contact_points[i]) < reach
        if near and wp.dot(obj.contact_normals[k], obj.contact_normals[i]) > _SAME_SIDE:
            n += 1.0
            if wp.randf(state) * n < 1.0:
                chosen = k
    return chosen


@wp.func
def _palm_near(hand: Hand, steer: Steer, c: wp.int32, reach: wp.float32, state: wp.uint32):
    """A contact point of the palm within reach of another, of those that may touch."""
    chosen = c
    n = float(0.0)
    for k in range(steer.palm_points.shape[0]):
        p = steer.palm_points[k]
        if wp.length(hand.contacts.points[p] - hand.contacts.points[c]) < reach:
            n += 1.0
            if wp.randf(state) * n < 1.0:
                chosen = p
    return chosen


@wp.kernel
def propose_moved(
    hand: Hand,
    obj: Object,
    steer: Steer,
    params: MoveValues,
    poses: Poses,
    seed: wp.array(dtype=wp.int32),
    proposals_out: ProposedPoses,
):
    """One of several moves of each pose with a palm contact: to near points of palm and object, with another roll.

    Args:
        seed: of the stage, (1,).
    """
    row, b = wp.tid()
    proposals_out.rating[row, b] = int(Rating.BLOCKED)
    palm = int(-1)
    if row < poses.rows[0]:
        palm = poses.palm_point[row]
    if palm < 0:
        return
    state = wp.rand_init(seed[0] + b, poses.index[row])
    R = wp.transform_get_rotation(poses.pose[row])
    i = _surface_near(obj, poses.palm_surface[row], params.reach, wp.rand_init(wp.randi(state)))
    palm = _palm_near(hand, steer, palm, params.reach, wp.rand_init(wp.randi(state)))
    n = hand.contacts.normals[palm]
    R = rotation_between(wp.quat_rotate(R, obj.contact_normals[i]), -n) * R
    R = wp.quat_from_axis_angle(n, params.angle * wp.randf(state, -1.0, 1.0)) * R
    T = wp.transform(hand.contacts.points[palm] - wp.quat_rotate(R, obj.contact_points[i]), R)
    if body_clear(hand, obj, 0, wp.transform_inverse(T), params.allowed_penetration):
        proposals_out.rating[row, b] = int(Rating.CLEAR)
    proposals_out.pose[row, b] = T
    proposals_out.palm_point[row, b] = palm
    proposals_out.surface[row, b] = i
    proposals_out.setting[row, b] = poses.setting[row]
    proposals_out.resting[row, b] = -1
    for k in range(proposals_out.anchor.shape[2]):
        proposals_out.anchor[row, b, k] = -1


@wp.kernel
def name_moved(poses: Poses, poses_out: Poses):
    """Moved poses are of the candidates that they come from; ``index`` is the row of ``poses`` on entry."""
    row = wp.tid()
    if row < poses_out.rows[0]:
        poses_out.index[row] = poses.index[poses_out.index[row]]

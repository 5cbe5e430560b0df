"""Kernel of the place stage that moves poses a little."""

import warp as wp

from lgrasp.grasp.collision import body_clear, body_depth
from lgrasp.grasp.structs import Poses
from lgrasp.hand.arrays import Hand
from lgrasp.math.transforms import rotation_between
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_DRAWS = wp.constant(4)  # of a move that static links do not block
_NEIGHBOURS = wp.constant(16.0)  # contact points before and after one, in order, that lie near it


@wp.struct
class MoveValues:
    """How far poses are moved, and GraspBounds as the kernel reads them."""

    family_move: wp.float32  # [m] standard deviation along an axis
    family_turn: wp.float32  # [rad] the same about an axis
    allowed_penetration: wp.float32  # [m]


@wp.func
def _normals(state: wp.uint32):
    return wp.vec3(wp.randn(state), wp.randn(state), wp.randn(state))


@wp.func
def _moved(params: MoveValues, T: wp.transform, com: wp.vec3, state: wp.uint32):
    """A pose turned about the centre of mass and moved."""
    spin = params.family_turn * _normals(wp.rand_init(wp.randi(state)))
    angle = wp.length(spin)
    R = wp.transform_get_rotation(T)
    if angle > 0.0:
        R = wp.quat_from_axis_angle(spin / angle, angle) * R
    at = wp.transform_point(T, com) + params.family_move * _normals(wp.rand_init(wp.randi(state) + 1))
    return wp.transform(at - wp.quat_rotate(R, com), R)


@wp.kernel
def move_poses(
    hand: Hand,
    obj: Object,
    params: MoveValues,
    seed: wp.array(dtype=wp.int32),
    poses: Poses,
    moved_out: Poses,
    clear_out: wp.array(dtype=wp.int32),
):
    """A pose near each given one; an object on the palm stays there, at a contact point near the one that touched.

    Args:
        seed: of the stage and pass, (1,).
        moved_out: of numbers that are given.
        clear_out: 1 if static links do not block it, (P,).
    """
    row = wp.tid()
    state = wp.rand_init(seed[0], moved_out.index[row])
    palm = poses.palm_point[row]
    T = poses.pose[row]
    i = poses.palm_surface[row]
    clear = int(0)
    for _t in range(_DRAWS):
        if clear == 0:
            T = _moved(params, poses.pose[row], obj.com, wp.rand_init(wp.randi(state)))
            if palm >= 0:
                aside = int((2.0 * wp.randf(state) - 1.0) * _NEIGHBOURS)
                i = wp.clamp(poses.palm_surface[row] + aside, 0, obj.contacts - 1)
                R = wp.transform_get_rotation(T)
                R = rotation_between(wp.quat_rotate(R, obj.contact_normals[i]), -hand.contacts.normals[palm]) * R
                T = wp.transform(hand.contacts.points[palm] - wp.quat_rotate(R, obj.contact_points[i]), R)
            T_object = wp.transform_inverse(T)
            slack = params.allowed_penetration
            if body_clear(hand, obj, 0, T_object, slack) and body_depth(hand, obj, 0, T_object, slack) <= slack:
                clear = int(1)
    clear_out[row] = clear
    moved_out.pose[row] = T
    moved_out.palm_point[row] = palm
    moved_out.palm_surface[row] = i
    moved_out.setting[row] = poses.setting[row]
    moved_out.resting[row] = poses.resting[row]
    for g in range(poses.anchor.shape[1]):
        moved_out.anchor[row, g] = poses.anchor[row, g]

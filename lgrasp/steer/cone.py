"""Warp functions that draw rotations with the palm's approach direction in a cone of the object's frame."""

import warp as wp

from lgrasp.math.transforms import rotation_between, tangent
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.steer.arrays import Steer

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def in_cone(steer: Steer, R: wp.quat):
    """True if an object turned by R, base frame, has the palm's direction in the cone."""
    return wp.dot(steer.facing, wp.quat_rotate(R, steer.approach)) >= steer.cosine


@wp.func
def rotation_in_cone(steer: Steer, state: wp.uint32):
    """A rotation of the object, uniform among those with the palm's direction in the cone."""
    c = wp.randf(state, steer.cosine, 1.0)
    s = wp.sqrt(wp.max(1.0 - c * c, 0.0))
    x = tangent(steer.approach)
    angle = wp.randf(state, 0.0, wp.TAU)
    direction = steer.approach * c + (x * wp.cos(angle) + wp.cross(steer.approach, x) * wp.sin(angle)) * s
    roll = wp.quat_from_axis_angle(steer.facing, wp.randf(state, 0.0, wp.TAU))
    return roll * rotation_between(direction, steer.facing)


@wp.func
def roll_in_cone(steer: Steer, R: wp.quat, axis: wp.vec3, u: wp.float32):
    """An angle about a unit ``axis`` of the base frame that turns an object with rotation R into the cone, u in [0, 1).

    Returns:
        The angle [rad], and whether there is one.
    """
    a = steer.facing
    c = wp.quat_rotate(R, steer.approach)
    # the part of both along the axis stays; the rest turns
    along = wp.dot(a, axis) * wp.dot(c, axis)
    across_a = a - axis * wp.dot(a, axis)
    across_c = c - axis * wp.dot(c, axis)
    reach = wp.length(across_a) * wp.length(across_c)
    if along + reach < steer.cosine:
        return float(0.0), bool(False)
    half = float(wp.PI)
    if along - reach < steer.cosine:
        half = wp.acos(wp.clamp((steer.cosine - along) / reach, -1.0, 1.0))
    nearest = wp.atan2(wp.dot(wp.cross(across_c, across_a), axis), wp.dot(across_c, across_a))
    return nearest + (2.0 * u - 1.0) * half, bool(True)

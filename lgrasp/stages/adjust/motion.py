"""Normal equations of a small motion of the object: a row (v, w) moves its point at ``arm`` by v + w x arm."""

import warp as wp

from lgrasp.math.cholesky import solving
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

vec6 = wp.types.vector(6, wp.float32)
_mat6 = wp.types.matrix((6, 6), wp.float32)
_solve = solving(6)

ROWS = 7
"""Rows of the equations: those of the matrix, then the right side."""


@wp.func
def motion_row(n: wp.vec3, arm: wp.vec3):
    """Coefficients in (v, w) of n . (v + w x arm)."""
    m = wp.cross(arm, n)
    return vec6(n[0], n[1], n[2], m[0], m[1], m[2])


@wp.func
def turn_row(m: wp.vec3):
    """Coefficients in (v, w) of m . w."""
    return vec6(0.0, 0.0, 0.0, m[0], m[1], m[2])


@wp.func
def add_distance(equations: wp.array(dtype=vec6), row: vec6, aim: wp.float32, weight: wp.float32):
    """weight (row . (v, w) - aim)^2 joins what is minimised."""
    for a in range(6):
        equations[a] = equations[a] + weight * row[a] * row
    equations[6] = equations[6] + weight * aim * row


@wp.func
def add_offset(equations: wp.array(dtype=vec6), arm: wp.vec3, aim: wp.vec3, weight: wp.float32):
    """weight |v + w x arm - aim|^2 joins it."""
    for a in range(3):
        axis = wp.vec3()
        axis[a] = 1.0
        add_distance(equations, motion_row(axis, arm), aim[a], weight)


@wp.func
def add_turn(equations: wp.array(dtype=vec6), normal: wp.vec3, aim: wp.vec3, weight: wp.float32):
    """weight |normal x w - aim|^2 joins it: the turned normal less the old one is -normal x w."""
    turn = wp.cross(aim, normal)
    for a in range(3):
        row = vec6()
        for b in range(3):
            row[3 + b] = -weight * normal[a] * normal[b]
        row[3 + a] = row[3 + a] + weight
        equations[3 + a] = equations[3 + a] + row
    equations[6] = equations[6] + weight * turn_row(turn)


@wp.func
def solve_motion(equations: wp.array(dtype=vec6), damping: wp.float32, lever: wp.float32):
    """The (v, w) that minimises it and damping (|v|^2 + lever^2 |w|^2)."""
    A = _mat6()
    for a in range(6):
        for b in range(6):
            A[a, b] = equations[a][b]
    for a in range(3):
        A[a, a] = A[a, a] + damping
        A[3 + a, 3 + a] = A[3 + a, 3 + a] + damping * lever * lever
    return _solve(A, equations[6], 6, 0.0, 1.0e-14)


@wp.func
def moved_pose(T: wp.transform, com: wp.vec3, motion: vec6, farthest: wp.float32, most: wp.float32):
    """The motion shortened to ``farthest`` [m] and ``most`` [rad], and the pose after it; it turns about ``com``."""
    v = wp.vec3(motion[0], motion[1], motion[2])
    w = wp.vec3(motion[3], motion[4], motion[5])
    angle = wp.length(w)
    share = wp.min(1.0, farthest / wp.max(wp.length(v), 1.0e-9))
    share = wp.min(share, most / wp.max(angle, 1.0e-9))
    R = wp.transform_get_rotation(T)
    if angle > 1.0e-7:
        R = wp.normalize(wp.quat_from_axis_angle(w / angle, share * angle) * R)
    at = wp.transform_point(T, com) + share * v
    return share * motion, wp.transform(at - wp.quat_rotate(R, com), R)

"""Gradient steps of hands on frozen matches, straight advances and depths: one thread a hand."""

import warp as wp

from lgrasp.grasp.collision import plane_height
from lgrasp.math.kinematics import Kinematics, group_dofs, group_forward
from lgrasp.math.limits import MAX_BODIES
from lgrasp.refine.energy_gradient import Search, joint_pulls, point_pulls, solid_pulls, wrench_pulls
from lgrasp.refine.match_kernels import Correspondences, Points, Solids
from lgrasp.refine.volume import Volume, volume_at
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_TINY = wp.constant(1.0e-12)
_SECOND_MOMENT_DECAY = wp.constant(0.99)  # decay of adam's second moment
_BODIES = MAX_BODIES + 1
_LAST_ADVANCE = 1.0e-5  # [m] an advance that is shorter is the last


@wp.struct
class Schedule:
    """Where in a search a launch is, and whether it moves anything."""

    taken: wp.int32  # steps before these
    skipped: wp.int32  # further steps that sizes fall by
    whole: wp.float32  # rounds of matching along which sizes fall
    gradient: wp.int32  # 1: take no step, leave the derivatives by translation, rotation and joints in the first moment


@wp.struct
class Moments:
    """Moments of the gradient by translation, rotation and joints."""

    first: wp.array2d(dtype=wp.float32)  # (N, 6 + K)
    second: wp.array2d(dtype=wp.float32)  # (N, 6 + K)


@wp.func
def _moved(moments: Moments, row: wp.int32, k: wp.int32, g: wp.float32, square: wp.float32, step: wp.int32, s: Search):
    """Share of the largest step, down, of coordinate k: adam's, or that of sgd with momentum."""
    mean = s.momentum * moments.first[row, k] + (1.0 - s.momentum) * g
    moments.first[row, k] = mean
    if s.sgd == 1:
        return -mean
    root = _SECOND_MOMENT_DECAY * moments.second[row, k] + (1.0 - _SECOND_MOMENT_DECAY) * square
    moments.second[row, k] = root
    mean = mean / (1.0 - wp.pow(s.momentum, float(step)))
    root = wp.sqrt(root / (1.0 - wp.pow(_SECOND_MOMENT_DECAY, float(step))))
    return -wp.clamp(mean / (root + _TINY), -1.0, 1.0)


@wp.func
def _three_moved(moments: Moments, row: wp.int32, k: wp.int32, g: wp.vec3, step: wp.int32, s: Search):
    """Of three coordinates; one scale for all: steps do not depend on the frame."""
    square = wp.length_sq(g) / 3.0
    v = g
    if s.sgd == 1:
        v = v / wp.max(wp.length(v), 1.0)
    return wp.vec3(
        _moved(moments, row, k, v[0], square, step, s),
        _moved(moments, row, k + 1, v[1], square, step, s),
        _moved(moments, row, k + 2, v[2], square, step, s),
    )


@wp.kernel
def descend(
    h: Kinematics,
    points: Points,
    solids: Solids,
    own: Volume,
    s: Search,
    m: Correspondences,
    schedule: Schedule,
    moments: Moments,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
):
    """``gradient_steps`` steps of hands, in place; launched over hands.

    Args:
        pose: T_object_hand, moved in place, (N,).
        q: [rad or m], moved in place, (N, K).
    """
    row = wp.tid()
    X = wp.zeros(shape=(_BODIES,), dtype=wp.transform)
    F = wp.zeros(shape=(_BODIES,), dtype=wp.vec3)
    M = wp.zeros(shape=(_BODIES,), dtype=wp.vec3)
    T = pose[row]
    bodies = 1 + h.joint_first[h.groups]
    for k in range(s.gradient_steps):
        for b in range(bodies):
            F[b] = wp.vec3()
            M[b] = wp.vec3()
        for g in range(h.groups):
            group_forward(h, g, group_dofs(h, g, q, row), X, 1 + h.joint_first[g])
        for b in range(1, bodies):
            X[b] = T * X[b]
        X[0] = T
        point_pulls(points, s, m, row, X, F, M)
        wrench_pulls(points, own, s, m, row, X, F, M)
        solid_pulls(solids, s, m, row, X, F, M)
        by_q = joint_pulls(h, s, q, row, X, F, M)
        centre = wp.transform_point(T, s.middle)
        by_shift = F[0]
        by_turn = M[0] - wp.cross(centre, by_shift)
        if schedule.gradient == 1:
            for e in range(3):
                moments.first[row, e] = by_shift[e]
                moments.first[row, 3 + e] = by_turn[e]
            for c in range(q.shape[1]):
                moments.first[row, 6 + c] = by_q[c]
            return
        step = schedule.taken + k + 1
        size = wp.pow(
            s.decay, float(schedule.skipped + schedule.taken + k) / (float(s.gradient_steps) * schedule.whole)
        )
        translation = s.max_translation_step * size * _three_moved(moments, row, 0, by_shift, step, s)
        rotation = s.max_rotation_step * size * _three_moved(moments, row, 3, by_turn, step, s)
        scale = float(1.0)
        if s.sgd == 1:
            norm = float(0.0)
            for c in range(q.shape[1]):
                norm += by_q[c] * by_q[c]
            scale = 1.0 / wp.max(wp.sqrt(norm), 1.0)
        for c in range(q.shape[1]):
            slope = by_q[c] * scale
            x = q[row, c] + s.max_joint_step * size * _moved(moments, row, 6 + c, slope, slope * slope, step, s)
            q[row, c] = wp.clamp(x, s.lower[c], s.upper[c])
        angle = wp.length(rotation)
        r = wp.quat_identity()
        if angle > 1.0e-9:
            r = wp.quat_from_axis_angle(rotation / angle, angle)
        at = centre + translation + wp.quat_rotate(r, wp.transform_get_translation(T) - centre)
        T = wp.transform(at, wp.normalize(r * wp.transform_get_rotation(T)))
    pose[row] = T


@wp.kernel
def advance(
    points: Points,
    own: Volume,
    around: Volume,
    has_around: wp.int32,
    most: wp.int32,
    clearance: wp.float32,
    direction: wp.array(dtype=wp.vec3),
    travel: wp.array(dtype=wp.float32),
    body: wp.array2d(dtype=wp.transform),
    pose: wp.array(dtype=wp.transform),
):
    """Hands moved straight until a point of theirs is ``clearance`` from anything; launched over hands.

    Args:
        direction: unit vectors, object frame, (N,).
        travel: how far at most [m], (N,).
        body: T_object_body, (N, B).
        pose: T_object_hand, moved in place, (N,).
    """
    row = wp.tid()
    gone = float(0.0)
    way = direction[row]
    for _ in range(most):
        gap = float(1.0e9)
        for block in range(points.body.shape[0]):
            T = body[row, points.body[block]]
            for i in range(block * points.block, (block + 1) * points.block):
                x = wp.transform_point(T, points.points[i]) + way * gone
                gap = wp.min(gap, volume_at(own, x)[3])
                if has_around == 1:
                    gap = wp.min(gap, volume_at(around, x)[3])
        step = wp.min(wp.max(gap - clearance, 0.0), travel[row] - gone)
        gone += step
        if step < _LAST_ADVANCE:
            break
    T = pose[row]
    pose[row] = wp.transform(wp.transform_get_translation(T) + way * gone, wp.transform_get_rotation(T))


@wp.kernel
def penetration(
    m: Correspondences,
    points: Points,
    solids: Solids,
    body: wp.array2d(dtype=wp.transform),
    penetration_out: wp.array(dtype=wp.float32),
):
    """Depth of the deepest point of hands in anything, or of that in them, at their matches [m]; over hands.

    Args:
        body: T_object_body, (N, B).
        penetration_out: [m], (N,).
    """
    row = wp.tid()
    deep = float(-1.0e9)
    for i in range(m.block.shape[1]):
        x = wp.transform_point(body[row, points.body[i // points.block]], points.points[i])
        deep = wp.max(deep, -plane_height(m.block[row, i], x))
    each = m.deep.shape[1] // solids.body.shape[0]
    for i in range(m.deep.shape[1]):
        T = wp.transform_inverse(body[row, solids.body[i // each]])
        deep = wp.max(deep, -plane_height(m.deep_plane[row, i], wp.transform_point(T, m.deep[row, i])))
    penetration_out[row] = deep

"""Gradient steps of hands on frozen matches, straight advances and depths."""

import warp as wp

from lgrasp.grasp.collision import plane_height
from lgrasp.math.kinematics import Kinematics, group_dofs, group_forward
from lgrasp.math.lanes import LANES, lanes_sum, meet
from lgrasp.refine.energy_gradient import (
    DescentScratch,
    DescentScratches,
    Search,
    gather_parts,
    joint_pulls,
    link_pulls,
    point_pulls,
    scratch_of,
    solid_pulls,
    wrench_pulls,
)
from lgrasp.refine.match_kernels import Correspondences, Points, Solids
from lgrasp.refine.volume import Volume, volume_at
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS | {"fast_math": True})

_BLOCKS = (LANES, 24)  # threads of a block, and blocks at a time: few registers each, as hands wait for memory
_TINY = wp.constant(1.0e-12)
_SECOND_MOMENT_DECAY = wp.constant(0.99)  # decay of adam's second moment
_LAST_ADVANCE = 1.0e-5  # [m] an advance that is shorter is the last


@wp.struct
class Schedule:
    """Where in a search a launch is, and whether it moves anything."""

    taken: wp.int32  # steps before these
    skipped: wp.int32  # further steps that sizes fall by
    whole: wp.float32  # rounds of matching along which sizes fall
    gradient: wp.int32  # 1: take no step, leave the derivatives by translation, rotation and joints in the first moment


@wp.struct
class Parts:
    """What pulls at hands."""

    points: Points
    solids: Solids
    own: Volume


@wp.struct
class Moments:
    """Moments of the gradient by translation, rotation and joints."""

    first: wp.array2d(dtype=wp.float32)  # (N, 6 + K)
    second: wp.array2d(dtype=wp.float32)  # (N, 6 + K)


@wp.func
def _moved(moments: Moments, row: wp.int32, k: wp.int32, g: wp.float32, square: wp.float32, known: wp.vec2, s: Search):
    """Share of the largest step, down, of coordinate k: adam's, or that of sgd with momentum; ``known`` is how much of
    the means comes from the steps until now."""
    mean = s.momentum * moments.first[row, k] + (1.0 - s.momentum) * g
    moments.first[row, k] = mean
    if s.sgd == 1:
        return -mean
    root = _SECOND_MOMENT_DECAY * moments.second[row, k] + (1.0 - _SECOND_MOMENT_DECAY) * square
    moments.second[row, k] = root
    mean = mean / known[0]
    root = wp.sqrt(root / known[1])
    return -wp.clamp(mean / (root + _TINY), -1.0, 1.0)


@wp.func
def _gradient(
    h: Kinematics,
    points: Points,
    solids: Solids,
    own: Volume,
    s: Search,
    m: Correspondences,
    row: wp.int32,
    q: wp.array2d(dtype=wp.float32),
    w: DescentScratch,
):
    """Write the derivatives of E* of a hand whose base is ``X[0]``: F and M of the base, and those by the joints."""
    for g in range(w.lane, h.groups, w.lanes):
        first = group_forward(h, g, group_dofs(h, g, q, row), w.X, 1 + h.joint_first[g])
        for b in range(1 + first, 1 + h.joint_first[g + 1]):
            w.X[b] = w.X[0] * w.X[b]
    meet()
    blocks = points.body.shape[0]
    point_pulls(points, s, m, row, w)
    wrench_pulls(points, own, s, m, row, blocks, w)
    solid_pulls(solids, s, m, row, blocks + s.contacts, w)
    meet()
    gather_parts(blocks + s.contacts + solids.body.shape[0], 1 + h.joint_first[h.groups], w)
    meet()
    link_pulls(solids, s, m, row, w)
    joint_pulls(h, s, q, row, w)


@wp.func
def _step(
    s: Search,
    schedule: Schedule,
    moments: Moments,
    row: wp.int32,
    k: wp.int32,
    q: wp.array2d(dtype=wp.float32),
    w: DescentScratch,
):
    """Take step k of a hand down the derivatives."""
    centre = wp.transform_point(w.X[0], s.middle)
    step = float(schedule.taken + k + 1)
    known = wp.vec2(1.0 - wp.pow(s.momentum, step), 1.0 - wp.pow(_SECOND_MOMENT_DECAY, step))
    size = wp.pow(s.decay, float(schedule.skipped + schedule.taken + k) / (float(s.gradient_steps) * schedule.whole))
    # one scale for all three coordinates: steps do not depend on the frame
    for e in range(w.lane, 6, w.lanes):
        g = w.F[0]
        largest = s.max_translation_step
        if e >= 3:
            g = w.M[0] - wp.cross(centre, g)
            largest = s.max_rotation_step
        square = wp.length_sq(g) / 3.0
        if s.sgd == 1:
            g = g / wp.max(wp.length(g), 1.0)
        w.moved[e] = largest * size * _moved(moments, row, e, g[e % 3], square, known, s)
    scale = float(1.0)
    if s.sgd == 1:
        norm = float(0.0)
        for c in range(w.lane, q.shape[1], w.lanes):
            norm += w.by_q[c] * w.by_q[c]
        scale = 1.0 / wp.max(wp.sqrt(lanes_sum(norm)), 1.0)
    for c in range(w.lane, q.shape[1], w.lanes):
        slope = w.by_q[c] * scale
        x = q[row, c] + s.max_joint_step * size * _moved(moments, row, 6 + c, slope, slope * slope, known, s)
        q[row, c] = wp.clamp(x, s.lower[c], s.upper[c])
    meet()
    if w.lane == 0:
        T = w.X[0]
        rotation = wp.vec3(w.moved[3], w.moved[4], w.moved[5])
        angle = wp.length(rotation)
        r = wp.quat_identity()
        if angle > 1.0e-9:
            r = wp.quat_from_axis_angle(rotation / angle, angle)
        at = centre + wp.vec3(w.moved[0], w.moved[1], w.moved[2])
        at += wp.quat_rotate(r, wp.transform_get_translation(T) - centre)
        w.X[0] = wp.transform(at, wp.normalize(r * wp.transform_get_rotation(T)))
    meet()


@wp.kernel(launch_bounds=_BLOCKS)
def descend(
    h: Kinematics,
    parts: Parts,
    s: Search,
    m: Correspondences,
    schedule: Schedule,
    scratch: DescentScratches,
    moments: Moments,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
):
    """``gradient_steps`` steps of hands, in place; launched over workers and their lanes.

    Args:
        pose: T_object_hand, moved in place, (N,).
        q: [rad or m], moved in place, (N, K).
    """
    worker, lane = wp.tid()
    w = scratch_of(scratch, worker, lane)
    for row in range(worker, pose.shape[0], scratch.X.shape[0]):
        if lane == 0:
            w.X[0] = pose[row]
        meet()
        # one place for the gradient: twice its instructions are more than a GPU keeps at hand
        for k in range(wp.where(schedule.gradient == 1, 1, s.gradient_steps)):
            _gradient(h, parts.points, parts.solids, parts.own, s, m, row, q, w)
            if schedule.gradient == 1:
                by_turn = w.M[0] - wp.cross(wp.transform_point(w.X[0], s.middle), w.F[0])
                for e in range(lane, 3, w.lanes):
                    moments.first[row, e] = w.F[0][e]
                    moments.first[row, 3 + e] = by_turn[e]
                for c in range(lane, q.shape[1], w.lanes):
                    moments.first[row, 6 + c] = w.by_q[c]
            else:
                _step(s, schedule, moments, row, k, q, w)
        if lane == 0:
            pose[row] = w.X[0]
        meet()


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

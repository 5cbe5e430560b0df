"""Gradient steps of hands on frozen matches, and straight advances: one thread a hand.

The gradient is that of E* (:mod:`lgrasp.refine.energy`), by hand: every term pulls at points of bodies, a body's pulls
make a force and a moment about the origin of the object's frame, and these go down the joints.
"""

import math

import warp as wp

from lgrasp.device.kinematics import MAX_BODIES, Kinematics, group_forward
from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.hand.arrays import group_dofs
from lgrasp.refine.match_kernels import Correspondences, Points, Solids
from lgrasp.refine.params import LENGTH, STEEPEST
from lgrasp.refine.volume import Volume, turning_normal, volume_at

__all__ = ["MAX_COLUMNS", "Search", "advance", "deepest", "descend"]

wp.set_module_options(KERNEL_OPTIONS)

MAX_COLUMNS = 32
"""Most joints that a hand's postures name."""

_LENGTH = wp.constant(LENGTH)
_STEEPEST = wp.constant(STEEPEST)
_LOG = math.log(STEEPEST)
_SLOPE = wp.constant(-2 * (STEEPEST - 1) * _LOG - (STEEPEST - 1) ** 2 / STEEPEST)
_BEND = wp.constant(-2 * _LOG - 4 * (STEEPEST - 1) / STEEPEST + (STEEPEST - 1) ** 2 / STEEPEST**2)
_TINY = wp.constant(1.0e-12)
_SECOND = wp.constant(0.99)  # decay of adam's second moment
_BODIES = MAX_BODIES + 1
_CLOSE = 1.0e-5  # [m] an advance that is shorter is the last

_vec_joints = wp.types.vector(MAX_COLUMNS, wp.float32)


@wp.struct
class Search:
    """Weights and sizes of the local search, scaled: see :class:`lgrasp.refine.params.LocalSearch`."""

    points: wp.float32  # over the sum of all weights
    normals: wp.float32  # the same
    force: wp.float32  # over the square of the number of contacts
    barrier: wp.float32
    limits: wp.float32  # over the number of joints
    margin: wp.float32
    link_margin: wp.float32
    contacts: wp.int32
    inner: wp.int32
    sgd: wp.int32
    momentum: wp.float32
    shift: wp.float32
    turn: wp.float32
    bend: wp.float32
    decay: wp.float32
    middle: wp.vec3  # what hands are turned about, base frame [m]
    com: wp.vec3
    radius: wp.float32
    lower: wp.array(dtype=wp.float32)
    upper: wp.array(dtype=wp.float32)
    near: wp.array(dtype=wp.float32)  # distance from a limit within which it repels


@wp.func
def _repulsion(u: wp.float32):
    """Derivative of the barrier."""
    if u >= 1.0:
        return 0.0
    if u < _STEEPEST:
        return _SLOPE + _BEND * (u - _STEEPEST)
    return -2.0 * (u - 1.0) * wp.log(u) - (u - 1.0) * (u - 1.0) / u


@wp.func
def _normal(plane: wp.vec4):
    return wp.vec3(plane[0], plane[1], plane[2])


@wp.func
def _beyond(plane: wp.vec4, x: wp.vec3):
    """Signed distance of x from a plane."""
    return plane[0] * x[0] + plane[1] * x[1] + plane[2] * x[2] - plane[3]


@wp.func
def _wrench_pulls(
    points: Points,
    own: Volume,
    s: Search,
    m: Correspondences,
    row: wp.int32,
    X: wp.array(dtype=wp.transform),
    F: wp.array(dtype=wp.vec3),
    M: wp.array(dtype=wp.vec3),
):
    """Of the net wrench of the contacts."""
    force = wp.vec3()
    torque = wp.vec3()
    for c in range(s.contacts):
        i = m.contacts[row, c]
        x = wp.transform_point(X[points.body[i // points.block]], points.points[i])
        n = _normal(volume_at(own, x))
        force -= n
        torque -= wp.cross((x - s.com) / s.radius, n)
    for c in range(s.contacts):
        i = m.contacts[row, c]
        b = points.body[i // points.block]
        x = wp.transform_point(X[b], points.points[i])
        at = turning_normal(own, x)
        by_n = -(force + wp.cross(torque, (x - s.com) / s.radius))
        f = wp.vec3(wp.dot(at.by_x, by_n), wp.dot(at.by_y, by_n), wp.dot(at.by_z, by_n))
        f = 2.0 * s.force * (f - wp.cross(at.n, torque) / s.radius)
        F[b] = F[b] + f
        M[b] = M[b] + wp.cross(x, f)


@wp.func
def _point_pulls(
    points: Points,
    s: Search,
    m: Correspondences,
    row: wp.int32,
    X: wp.array(dtype=wp.transform),
    F: wp.array(dtype=wp.vec3),
    M: wp.array(dtype=wp.vec3),
):
    """Of the planes that points are drawn to and kept beyond."""
    for block in range(points.body.shape[0]):
        b = points.body[block]
        R = wp.quat_to_matrix(wp.transform_get_rotation(X[b]))
        t = wp.transform_get_translation(X[b])
        total = wp.vec3()
        moment = wp.vec3()
        for i in range(block * points.block, (block + 1) * points.block):
            x = R * points.points[i] + t
            wall = m.block[row, i]
            f = wp.vec3()
            u = _beyond(wall, x) / s.margin
            if u < 1.0:
                f = _normal(wall) * (s.barrier * _repulsion(u) / s.margin)
            pull = m.pull[row, i]
            if pull > 0.0:
                plane = m.plane[row, i]
                n = _normal(plane)
                f += n * (2.0 * s.points * pull * _beyond(plane, x) / (_LENGTH * _LENGTH))
                own = R * points.normals[i]
                moment += wp.cross(own, n) * (2.0 * s.normals * pull * (wp.dot(own, n) + 1.0))
            total += f
            moment += wp.cross(x, f)
        F[b] = F[b] + total
        M[b] = M[b] + moment


@wp.func
def _solid_pulls(
    solids: Solids,
    s: Search,
    m: Correspondences,
    row: wp.int32,
    X: wp.array(dtype=wp.transform),
    F: wp.array(dtype=wp.vec3),
    M: wp.array(dtype=wp.vec3),
):
    """Of the object's points, and other links' points, that links are kept off."""
    links = solids.body.shape[0]
    each = m.deep.shape[1] // links
    for i in range(m.deep.shape[1]):
        plane = m.deep_plane[row, i]
        b = solids.body[i // each]
        x = m.deep[row, i]
        u = _beyond(plane, wp.transform_point(wp.transform_inverse(X[b]), x)) / s.margin
        if u < 1.0:
            f = wp.transform_vector(X[b], _normal(plane)) * (s.barrier * _repulsion(u) / s.margin)
            F[b] = F[b] - f
            M[b] = M[b] - wp.cross(x, f)
    pairs = solids.pairs.shape[0]
    for i in range(m.link_plane.shape[1]):
        plane = m.link_plane[row, i]
        if wp.length_sq(_normal(plane)) > 0.0:
            pair = solids.pairs[i * pairs // m.link_plane.shape[1]]
            a = solids.body[pair[0]]
            b = solids.body[pair[1]]
            x = wp.transform_point(X[a], m.link_deep[row, i])
            u = _beyond(plane, wp.transform_point(wp.transform_inverse(X[b]), x)) / s.link_margin
            if u < 1.0:
                f = wp.transform_vector(X[b], _normal(plane)) * (s.barrier * _repulsion(u) / s.link_margin)
                F[a] = F[a] + f
                M[a] = M[a] + wp.cross(x, f)
                F[b] = F[b] - f
                M[b] = M[b] - wp.cross(x, f)


@wp.func
def _joint_pulls(
    h: Kinematics,
    s: Search,
    q: wp.array2d(dtype=wp.float32),
    row: wp.int32,
    X: wp.array(dtype=wp.transform),
    F: wp.array(dtype=wp.vec3),
    M: wp.array(dtype=wp.vec3),
):
    """Derivatives by the joints; F and M of a body become those of all that rides on it."""
    g = _vec_joints()
    for group in range(h.groups):
        first = h.joint_first[group]
        count = h.joint_first[group + 1] - first
        for e in range(count):
            j = count - 1 - e
            k = first + j
            f = F[1 + k]
            moment = M[1 + k]
            parent = h.joint_parent[k]
            up = int(0)
            if parent >= 0:
                up = 1 + first + parent
            F[up] = F[up] + f
            M[up] = M[up] + moment
            axis = wp.transform_vector(X[1 + k], h.joint_axis[k])
            slope = wp.dot(axis, f)
            if h.joint_prismatic[k] == 0:
                slope = wp.dot(axis, moment - wp.cross(wp.transform_get_translation(X[1 + k]), f))
            column = h.dof_index[h.dof_first[group] + h.joint_dof[k]]
            g[column] = g[column] + h.joint_mult[k] * slope
    for c in range(q.shape[1]):
        low = _repulsion((q[row, c] - s.lower[c]) / s.near[c])
        high = _repulsion((s.upper[c] - q[row, c]) / s.near[c])
        g[c] = g[c] + s.limits * (low - high) / s.near[c]
    return g


@wp.func
def _moved(
    first: wp.array2d(dtype=wp.float32),
    second: wp.array2d(dtype=wp.float32),
    row: wp.int32,
    k: wp.int32,
    g: wp.float32,
    square: wp.float32,
    step: wp.int32,
    s: Search,
):
    """Share of the largest step, down, of coordinate k: adam's, or that of sgd with momentum."""
    mean = s.momentum * first[row, k] + (1.0 - s.momentum) * g
    first[row, k] = mean
    if s.sgd == 1:
        return -mean
    root = _SECOND * second[row, k] + (1.0 - _SECOND) * square
    second[row, k] = root
    mean = mean / (1.0 - wp.pow(s.momentum, float(step)))
    root = wp.sqrt(root / (1.0 - wp.pow(_SECOND, float(step))))
    return -wp.clamp(mean / (root + _TINY), -1.0, 1.0)


@wp.func
def _three_moved(
    first: wp.array2d(dtype=wp.float32),
    second: wp.array2d(dtype=wp.float32),
    row: wp.int32,
    k: wp.int32,
    g: wp.vec3,
    step: wp.int32,
    s: Search,
):
    """Of three coordinates; one scale for all: steps do not depend on the frame."""
    square = wp.length_sq(g) / 3.0
    v = g
    if s.sgd == 1:
        v = v / wp.max(wp.length(v), 1.0)
    return wp.vec3(
        _moved(first, second, row, k, v[0], square, step, s),
        _moved(first, second, row, k + 1, v[1], square, step, s),
        _moved(first, second, row, k + 2, v[2], square, step, s),
    )


@wp.kernel
def descend(
    h: Kinematics,
    points: Points,
    solids: Solids,
    own: Volume,
    s: Search,
    m: Correspondences,
    taken: wp.int32,
    skipped: wp.int32,
    whole: wp.float32,
    gradient: wp.int32,
    first: wp.array2d(dtype=wp.float32),
    second: wp.array2d(dtype=wp.float32),
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
):
    """``inner`` steps of hands, in place; launched over hands.

    Args:
        taken: steps before these. skipped: further ones that sizes fall by. whole: outer steps along which they fall.
        first, second: moments of the gradient.
        gradient: 1: take no step, leave the derivatives by shift, turn and joints in ``first``.
    """
    row = wp.tid()
    X = wp.zeros(shape=(_BODIES,), dtype=wp.transform)
    F = wp.zeros(shape=(_BODIES,), dtype=wp.vec3)
    M = wp.zeros(shape=(_BODIES,), dtype=wp.vec3)
    T = pose[row]
    bodies = 1 + h.joint_first[h.groups]
    for inner in range(s.inner):
        for b in range(bodies):
            F[b] = wp.vec3()
            M[b] = wp.vec3()
        for g in range(h.groups):
            group_forward(h, g, group_dofs(h, g, q, row), X, 1 + h.joint_first[g])
        for b in range(1, bodies):
            X[b] = T * X[b]
        X[0] = T
        _point_pulls(points, s, m, row, X, F, M)
        _wrench_pulls(points, own, s, m, row, X, F, M)
        _solid_pulls(solids, s, m, row, X, F, M)
        by_q = _joint_pulls(h, s, q, row, X, F, M)
        centre = wp.transform_point(T, s.middle)
        by_shift = F[0]
        by_turn = M[0] - wp.cross(centre, by_shift)
        if gradient == 1:
            for e in range(3):
                first[row, e] = by_shift[e]
                first[row, 3 + e] = by_turn[e]
            for c in range(q.shape[1]):
                first[row, 6 + c] = by_q[c]
            return
        step = taken + inner + 1
        size = wp.pow(s.decay, float(skipped + taken + inner) / (float(s.inner) * whole))
        shift = s.shift * size * _three_moved(first, second, row, 0, by_shift, step, s)
        turn = s.turn * size * _three_moved(first, second, row, 3, by_turn, step, s)
        scale = float(1.0)
        if s.sgd == 1:
            norm = float(0.0)
            for c in range(q.shape[1]):
                norm += by_q[c] * by_q[c]
            scale = 1.0 / wp.max(wp.sqrt(norm), 1.0)
        for c in range(q.shape[1]):
            slope = by_q[c] * scale
            x = q[row, c] + s.bend * size * _moved(first, second, row, 6 + c, slope, slope * slope, step, s)
            q[row, c] = wp.clamp(x, s.lower[c], s.upper[c])
        angle = wp.length(turn)
        r = wp.quat_identity()
        if angle > 1.0e-9:
            r = wp.quat_from_axis_angle(turn / angle, angle)
        at = centre + shift + wp.quat_rotate(r, wp.transform_get_translation(T) - centre)
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
    """Hands moved straight until a point of theirs is ``clearance`` from anything; launched over hands."""
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
        if step < _CLOSE:
            break
    T = pose[row]
    pose[row] = wp.transform(wp.transform_get_translation(T) + way * gone, wp.transform_get_rotation(T))


@wp.kernel
def deepest(
    m: Correspondences,
    points: Points,
    solids: Solids,
    body: wp.array2d(dtype=wp.transform),
    depth_out: wp.array(dtype=wp.float32),
):
    """Depth of the deepest point of hands in anything, or of that in them, at their matches [m]; over hands."""
    row = wp.tid()
    deep = float(-1.0e9)
    for i in range(m.block.shape[1]):
        x = wp.transform_point(body[row, points.body[i // points.block]], points.points[i])
        deep = wp.max(deep, -_beyond(m.block[row, i], x))
    each = m.deep.shape[1] // solids.body.shape[0]
    for i in range(m.deep.shape[1]):
        T = wp.transform_inverse(body[row, solids.body[i // each]])
        deep = wp.max(deep, -_beyond(m.deep_plane[row, i], wp.transform_point(T, m.deep[row, i])))
    depth_out[row] = deep

"""The gradient of E* (:mod:`lgrasp.refine.energy`) by the motions of a hand, written out.

Every term pulls at points of bodies; a body's pulls make a force F and a moment M about the origin of the object's
frame, and these go down the joints.
"""

import math

import warp as wp

from lgrasp.grasp.collision import plane_height
from lgrasp.math.kinematics import Kinematics
from lgrasp.math.transforms import transforms, vec3s
from lgrasp.refine.match_kernels import Correspondences, Points, Solids
from lgrasp.refine.params import LENGTH, STEEPEST
from lgrasp.refine.volume import Volume, turning_normal, volume_at
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

MAX_COLUMNS = 32
"""Most joints that a hand's postures name."""

_LOG_STEEPEST = math.log(STEEPEST)
_PARABOLA_SLOPE = wp.constant(-2 * (STEEPEST - 1) * _LOG_STEEPEST - (STEEPEST - 1) ** 2 / STEEPEST)
_PARABOLA_CONSTANT = wp.constant(-2 * _LOG_STEEPEST - 4 * (STEEPEST - 1) / STEEPEST + (STEEPEST - 1) ** 2 / STEEPEST**2)

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
    gradient_steps: wp.int32
    sgd: wp.int32
    momentum: wp.float32
    max_translation_step: wp.float32
    max_rotation_step: wp.float32
    max_joint_step: wp.float32
    decay: wp.float32
    middle: wp.vec3  # what hands are turned about, base frame [m]
    com: wp.vec3
    radius: wp.float32
    lower: wp.array(dtype=wp.float32)  # (K,) [rad or m]
    upper: wp.array(dtype=wp.float32)  # (K,) [rad or m]
    near: wp.array(dtype=wp.float32)  # (K,) distance from a limit within which it repels [rad or m]


@wp.func
def _repulsion(u: wp.float32):
    """Derivative of the barrier."""
    if u >= 1.0:
        return 0.0
    if u < STEEPEST:
        return _PARABOLA_SLOPE + _PARABOLA_CONSTANT * (u - STEEPEST)
    return -2.0 * (u - 1.0) * wp.log(u) - (u - 1.0) * (u - 1.0) / u


@wp.func
def _normal(plane: wp.vec4):
    return wp.vec3(plane[0], plane[1], plane[2])


@wp.func
def wrench_pulls(
    points: Points, own: Volume, s: Search, m: Correspondences, row: wp.int32, X: transforms, F: vec3s, M: vec3s
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
def point_pulls(points: Points, s: Search, m: Correspondences, row: wp.int32, X: transforms, F: vec3s, M: vec3s):
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
            u = plane_height(wall, x) / s.margin
            if u < 1.0:
                f = _normal(wall) * (s.barrier * _repulsion(u) / s.margin)
            pull = m.pull[row, i]
            if pull > 0.0:
                plane = m.plane[row, i]
                n = _normal(plane)
                f += n * (2.0 * s.points * pull * plane_height(plane, x) / (LENGTH * LENGTH))
                own = R * points.normals[i]
                moment += wp.cross(own, n) * (2.0 * s.normals * pull * (wp.dot(own, n) + 1.0))
            total += f
            moment += wp.cross(x, f)
        F[b] = F[b] + total
        M[b] = M[b] + moment


@wp.func
def solid_pulls(solids: Solids, s: Search, m: Correspondences, row: wp.int32, X: transforms, F: vec3s, M: vec3s):
    """Of the object's points, and other links' points, that links are kept off."""
    links = solids.body.shape[0]
    each = m.deep.shape[1] // links
    for i in range(m.deep.shape[1]):
        plane = m.deep_plane[row, i]
        b = solids.body[i // each]
        x = m.deep[row, i]
        u = plane_height(plane, wp.transform_point(wp.transform_inverse(X[b]), x)) / s.margin
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
            u = plane_height(plane, wp.transform_point(wp.transform_inverse(X[b]), x)) / s.link_margin
            if u < 1.0:
                f = wp.transform_vector(X[b], _normal(plane)) * (s.barrier * _repulsion(u) / s.link_margin)
                F[a] = F[a] + f
                M[a] = M[a] + wp.cross(x, f)
                F[b] = F[b] - f
                M[b] = M[b] - wp.cross(x, f)


@wp.func
def joint_pulls(
    h: Kinematics, s: Search, q: wp.array2d(dtype=wp.float32), row: wp.int32, X: transforms, F: vec3s, M: vec3s
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

"""The gradient of E* (:mod:`lgrasp.refine.energy`) by the motions of a hand, written out.

Every term pulls at points of bodies; a body's pulls make a force F and a moment M about the origin of the object's
frame, and these go down the joints.
"""

import warp as wp

from lgrasp.grasp.collision import plane_height
from lgrasp.math.kinematics import Kinematics
from lgrasp.math.lanes import lanes_least, lanes_sum, meet, neighbours_sum
from lgrasp.math.scratch import rows_of
from lgrasp.refine.match_kernels import LINK_DEEPEST, Correspondences, Points, Solids
from lgrasp.refine.params import LENGTH, PARABOLA_BEND, PARABOLA_SLOPE, STEEPEST, LocalSearch
from lgrasp.refine.volume import Volume, turning_normal, volume_at
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import params_struct

wp.set_module_options(KERNEL_OPTIONS)

MAX_COLUMNS = 32
"""Most joints that a hand's postures name."""

_BLOCK_LANES, _LINK_LANES = wp.constant(8), wp.constant(4)  # that work on one block of points, one link


@wp.struct
class DescentScratch:
    """What the lanes of a hand share."""

    lane: wp.int32
    lanes: wp.int32
    X: wp.array(dtype=wp.transform)  # (B,) T_object_body
    F: wp.array(dtype=wp.vec3)  # (B,)
    M: wp.array(dtype=wp.vec3)  # (B,)
    part_body: wp.array(dtype=wp.int32)  # (parts,) of blocks of points, contacts, links
    part_force: wp.array(dtype=wp.vec3)  # (parts,)
    part_moment: wp.array(dtype=wp.vec3)  # (parts,)
    by_joint: wp.array(dtype=wp.float32)  # (J,)
    by_q: wp.array(dtype=wp.float32)  # (K,)
    moved: wp.array(dtype=wp.float32)  # (6,) translation [m] and rotation [rad] of a step


DescentScratches, scratch_of = rows_of(DescentScratch)


Search = params_struct(
    *("Search", __name__, LocalSearch),
    sgd=wp.int32,
    middle=wp.vec3,  # what hands are turned about, base frame [m]
    com=wp.vec3,
    radius=wp.float32,
    lower=wp.array(dtype=wp.float32),  # (K,) [rad or m]
    upper=wp.array(dtype=wp.float32),  # (K,) [rad or m]
    column=wp.array(dtype=wp.int32),  # (J,) column of q that moves each joint
    near=wp.array(dtype=wp.float32),  # (K,) distance from a limit within which it repels [rad or m]
)
"""Weights and sizes of the local search; weights of ``points`` and ``normals`` are over the sum of all points' weights,
``force`` over the square of the number of contacts, ``limits`` over the number of joints."""


@wp.func
def _repulsion(u: wp.float32):
    """Derivative of the barrier."""
    if u >= 1.0:
        return 0.0
    if u < STEEPEST:
        return PARABOLA_SLOPE + PARABOLA_BEND * (u - STEEPEST)
    return -2.0 * (u - 1.0) * wp.log(u) - (u - 1.0) * (u - 1.0) / u


@wp.func
def _normal(plane: wp.vec4):
    return wp.vec3(plane[0], plane[1], plane[2])


@wp.func
def point_pulls(points: Points, s: Search, m: Correspondences, row: wp.int32, w: DescentScratch):
    """Of the planes that points are drawn to and kept beyond: a part for each block."""
    side = wp.min(w.lanes, _BLOCK_LANES)
    for start in range(0, points.body.shape[0], w.lanes // side):
        block = start + w.lane // side
        b = int(0)
        total = wp.vec3()
        moment = wp.vec3()
        if block < points.body.shape[0]:
            b = points.body[block]
            R = wp.quat_to_matrix(wp.transform_get_rotation(w.X[b]))
            t = wp.transform_get_translation(w.X[b])
            for i in range(block * points.block + w.lane % side, (block + 1) * points.block, side):
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
        for e in range(3):
            total[e] = neighbours_sum(total[e], side)
            moment[e] = neighbours_sum(moment[e], side)
        if block < points.body.shape[0] and w.lane % side == 0:
            w.part_body[block] = b
            w.part_force[block] = total
            w.part_moment[block] = moment


@wp.func
def wrench_pulls(
    points: Points, own: Volume, s: Search, m: Correspondences, row: wp.int32, first: wp.int32, w: DescentScratch
):
    """Of the net wrench of the contacts: a part for each, from ``first`` on."""
    force = wp.vec3()
    torque = wp.vec3()
    for c in range(w.lane, s.contacts, w.lanes):
        i = m.contacts[row, c]
        x = wp.transform_point(w.X[points.body[i // points.block]], points.points[i])
        n = _normal(volume_at(own, x))
        force -= n
        torque -= wp.cross((x - s.com) / s.radius, n)
    force = wp.vec3(lanes_sum(force[0]), lanes_sum(force[1]), lanes_sum(force[2]))
    torque = wp.vec3(lanes_sum(torque[0]), lanes_sum(torque[1]), lanes_sum(torque[2]))
    for c in range(w.lane, s.contacts, w.lanes):
        i = m.contacts[row, c]
        b = points.body[i // points.block]
        x = wp.transform_point(w.X[b], points.points[i])
        at = turning_normal(own, x)
        by_n = -(force + wp.cross(torque, (x - s.com) / s.radius))
        f = wp.vec3(wp.dot(at.by_x, by_n), wp.dot(at.by_y, by_n), wp.dot(at.by_z, by_n))
        f = 2.0 * s.force * (f - wp.cross(at.n, torque) / s.radius)
        w.part_body[first + c] = b
        w.part_force[first + c] = f
        w.part_moment[first + c] = wp.cross(x, f)


@wp.func
def solid_pulls(solids: Solids, s: Search, m: Correspondences, row: wp.int32, first: wp.int32, w: DescentScratch):
    """Of the object's points that links are kept off: a part for each link, from ``first`` on."""
    each = m.deep.shape[1] // solids.body.shape[0]
    side = wp.min(w.lanes, _LINK_LANES)
    for start in range(0, solids.body.shape[0], w.lanes // side):
        link = start + w.lane // side
        b = int(0)
        total = wp.vec3()
        moment = wp.vec3()
        if link < solids.body.shape[0]:
            b = solids.body[link]
            for i in range(link * each + w.lane % side, (link + 1) * each, side):
                plane = m.deep_plane[row, i]
                x = m.deep[row, i]
                u = plane_height(plane, wp.transform_point(wp.transform_inverse(w.X[b]), x)) / s.margin
                if u < 1.0:
                    f = wp.transform_vector(w.X[b], _normal(plane)) * (s.barrier * _repulsion(u) / s.margin)
                    total -= f
                    moment -= wp.cross(x, f)
        for e in range(3):
            total[e] = neighbours_sum(total[e], side)
            moment[e] = neighbours_sum(moment[e], side)
        if link < solids.body.shape[0] and w.lane % side == 0:
            w.part_body[first + link] = b
            w.part_force[first + link] = total
            w.part_moment[first + link] = moment


@wp.func
def gather_parts(count: wp.int32, bodies: wp.int32, w: DescentScratch):
    """Force and moment of every body by its parts."""
    for b in range(w.lane, bodies, w.lanes):
        f = wp.vec3()
        moment = wp.vec3()
        for part in range(count):
            if w.part_body[part] == b:
                f += w.part_force[part]
                moment += w.part_moment[part]
        w.F[b] = f
        w.M[b] = moment


@wp.func
def link_pulls(solids: Solids, s: Search, m: Correspondences, row: wp.int32, w: DescentScratch):
    """Of other links' points that links are kept off, added to the bodies; few are near enough."""
    count = m.links[row] * LINK_DEEPEST
    for start in range(0, count, w.lanes):
        i = start + w.lane
        near = int(0)
        a = int(0)
        b = int(0)
        f = wp.vec3()
        x = wp.vec3()
        if i < count:
            plane = m.link_plane[row, i]
            pair = solids.pairs[m.link_pair[row, i // LINK_DEEPEST]]
            a = solids.body[pair[0]]
            b = solids.body[pair[1]]
            x = wp.transform_point(w.X[a], m.link_deep[row, i])
            u = plane_height(plane, wp.transform_point(wp.transform_inverse(w.X[b]), x)) / s.link_margin
            if u < 1.0:
                near = 1
                f = wp.transform_vector(w.X[b], _normal(plane)) * (s.barrier * _repulsion(u) / s.link_margin)
        if lanes_least(-near) < 0:
            for turn in range(w.lanes):
                if turn == w.lane and near == 1:
                    w.F[a] = w.F[a] + f
                    w.M[a] = w.M[a] + wp.cross(x, f)
                    w.F[b] = w.F[b] - f
                    w.M[b] = w.M[b] - wp.cross(x, f)
                meet()


@wp.func
def joint_pulls(h: Kinematics, s: Search, q: wp.array2d(dtype=wp.float32), row: wp.int32, w: DescentScratch):
    """Write the derivatives by the joints; F and M of a body become those of all that rides on it."""
    for group in range(w.lane, h.groups, w.lanes):
        first = h.joint_first[group]
        count = h.joint_first[group + 1] - first
        for e in range(count):
            k = first + count - 1 - e
            f = w.F[1 + k]
            moment = w.M[1 + k]
            parent = h.joint_parent[k]
            if parent >= 0:
                up = 1 + first + parent
                w.F[up] = w.F[up] + f
                w.M[up] = w.M[up] + moment
            axis = wp.transform_vector(w.X[1 + k], h.joint_axis[k])
            slope = wp.dot(axis, f)
            if h.joint_prismatic[k] == 0:
                slope = wp.dot(axis, moment - wp.cross(wp.transform_get_translation(w.X[1 + k]), f))
            w.by_joint[k] = h.joint_mult[k] * slope
    meet()
    if w.lane == 0:
        for group in range(h.groups):
            first = h.joint_first[group]
            for k in range(first, h.joint_first[group + 1]):
                if h.joint_parent[k] < 0:
                    w.F[0] = w.F[0] + w.F[1 + k]
                    w.M[0] = w.M[0] + w.M[1 + k]
    for c in range(w.lane, q.shape[1], w.lanes):
        low = _repulsion((q[row, c] - s.lower[c]) / s.near[c])
        high = _repulsion((s.upper[c] - q[row, c]) / s.near[c])
        g = s.limits * (low - high) / s.near[c]
        for k in range(s.column.shape[0]):
            if s.column[k] == c:
                g += w.by_joint[k]
        w.by_q[c] = g
    meet()

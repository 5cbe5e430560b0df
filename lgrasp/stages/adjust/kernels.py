"""Kernels of the adjust stage: object and fingers move together until all contacts of a set are made."""

from typing import Any

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.structs import Candidates, Sets, State
from lgrasp.hand.arrays import Hand, contact_allowed, thumb_placed
from lgrasp.math.cholesky import solving
from lgrasp.math.kinematics import clamp_dofs, group_forward, point_column
from lgrasp.math.limits import DOF_SIZES, MAX_GROUPS, MAX_JOINTS
from lgrasp.math.sdf import sdf_gradient, sdf_of
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.adjust.depth import deepest_of
from lgrasp.stages.adjust.motion import (
    ROWS,
    add_distance,
    add_offset,
    add_turn,
    motion_row,
    moved_pose,
    solve_motion,
    turn_row,
    vec6,
)
from lgrasp.stages.adjust.structs import AdjustCount, Adjusted, AdjustValues, FaceContact, Progress

wp.set_module_options(KERNEL_OPTIONS)

_SAME_FACE = wp.constant(0.85)  # least cosine of a link's normals while its contact slides
_NEAR, _NEAR_COSINE, _NEAR_DEPTH = wp.constant(0.003), wp.constant(0.8), wp.constant(0.01)  # [m], -, [m]
FIRST_DEPTH = wp.constant(1)
"""Step at which penetration is looked at first."""
_FIRST_BOTH = wp.constant(2)  # and both ways, where contacts are not made earlier


@wp.func
def _touch_at(hand: Hand, k: wp.int32):
    """A contact before it slides: contact point k of the hand."""
    touch = FaceContact()
    touch.local = hand.contacts.points[k]
    touch.out = hand.contacts.normals[k]
    return touch


@wp.func
def _slid(hand: Hand, grid: wp.int32, touch: FaceContact, target: wp.vec3):
    """The contact after it slid to the point of the link nearest to ``target`` (body frame), as long as that lies on
    the same face."""
    e = sdf_gradient(sdf_of(hand.contacts.grids, grid), target)
    out = wp.vec3(e[0], e[1], e[2])
    touch.beside = 1
    if wp.dot(out, touch.out) > _SAME_FACE:
        touch.beside = 0
        touch.local = target - out * e[3]
        touch.out = out
        touch.gap = e[3]
    return touch


@wp.func
def _made(hand: Hand, params: AdjustValues, grid: wp.int32, touch: FaceContact, facing: wp.float32):
    """True if a contact is made; ``facing`` is the cosine of its normals."""
    there = touch.beside == 0 and wp.abs(touch.gap + params.contact_indentation) <= params.gap
    return there and facing >= params.cosine and contact_allowed(hand.contacts, grid, touch.out)


@wp.func
def _is_near(params: AdjustValues, touch: FaceContact, facing: wp.float32):
    """True if a contact may yet be made."""
    off = wp.abs(touch.gap + params.contact_indentation)
    return touch.beside == 0 and off <= _NEAR and facing >= _NEAR_COSINE


@wp.func
def _looseness(params: AdjustValues, touch: FaceContact):
    """Weight of the offset along the face: a contact slides on its face, and comes back from beside it."""
    return wp.where(touch.beside == 1, 1.0, params.slide_weight)


@wp.func
def _turn_weight(params: AdjustValues):
    """Weight of the squared angle of two normals [m^2]."""
    w = params.normal_weight * params.lever
    return w * w


@wp.func
def _add_object_rows(
    equations: wp.array(dtype=vec6),
    params: AdjustValues,
    touch: FaceContact,
    p: wp.vec3,
    n: wp.vec3,
    target: wp.vec3,
    centre: wp.vec3,
    normal: wp.vec3,
):
    """What a contact at p with normal n asks of the object's motion about ``centre``, base frame."""
    aim = p - n * params.contact_indentation - target
    arm = target - centre
    add_distance(equations, motion_row(n, arm), wp.dot(n, aim), 1.0)
    add_offset(equations, arm, aim, _looseness(params, touch))
    add_turn(equations, normal, normal - n, _turn_weight(params))


@wp.kernel
def begin_sets(field: Field, hand: Hand, sets: Sets, candidates: Candidates, moved_out: Candidates, sets_out: Adjusted):
    """Copies sets: a pose and one candidate of each group that touches."""
    i = wp.tid()
    row = sets.pose[i]
    groups = sets.chosen.shape[1]
    sets_out.progress[i] = int(Progress.GOING)
    sets_out.both[i] = 0
    for g in range(groups):
        m = sets.chosen[i, g]
        moved_out.count[i, g] = wp.where(m >= 0, 1, 0)
        if m >= 0:
            moved_out.surface[i, g, 0] = candidates.surface[row, g, m]
            moved_out.record[i, g, 0] = candidates.record[row, g, m]
            moved_out.q[i, g, 0] = candidates.q[row, g, m]
            moved_out.state[i, g, 0] = int(State.REALISED)
            sets_out.touch[i, g] = _touch_at(hand, field.point[candidates.record[row, g, m]])
        moved_out.poses.anchor[i, g] = candidates.poses.anchor[row, g]
    moved_out.poses.index[i] = candidates.poses.index[row]
    moved_out.poses.pose[i] = candidates.poses.pose[row]
    moved_out.poses.palm_point[i] = candidates.poses.palm_point[row]
    moved_out.poses.palm_surface[i] = candidates.poses.palm_surface[row]
    moved_out.poses.setting[i] = candidates.poses.setting[row]
    moved_out.poses.resting[i] = candidates.poses.resting[row]
    if moved_out.poses.palm_point[i] >= 0:
        sets_out.touch[i, groups] = _touch_at(hand, moved_out.poses.palm_point[i])


def _stepping(size: int) -> Any:
    """The kernel for groups of at most ``size`` dofs."""
    square, column, solve = wp.types.matrix((size, size), wp.float32), wp.types.vector(size, wp.float32), solving(size)
    lines = MAX_GROUPS * size

    @wp.func
    def eliminate(
        A: square,
        b: column,
        mixed: wp.array(dtype=vec6),
        own: wp.array(dtype=column),
        g: wp.int32,
        equations: wp.array(dtype=vec6),
    ):
        """The joints of a group leave the equations (Schur complement).

        Args:
            mixed: products of joints and motion on entry, (groups * size,); then dq / d(motion), negative.
            own: steps of the joints where the object rests, (groups,).
        """
        y = solve(A, b, size, 0.0, 1.0e-12)
        own[g] = y
        for c in range(6):
            beside = column()
            for a in range(size):
                beside[a] = mixed[g * size + a][c]
            z = solve(A, beside, size, 0.0, 1.0e-12)
            taken = vec6()
            for a in range(size):
                row = mixed[g * size + a]
                for d in range(6):
                    # columns before c hold dq / d(motion) already; the matrix is symmetric
                    if d >= c:
                        taken[d] = taken[d] + z[a] * row[d]
                equations[6][c] -= beside[a] * y[a]
                row[c] = z[a]
                mixed[g * size + a] = row
            for d in range(c, 6):
                equations[d][c] -= taken[d]

    @wp.kernel
    def step_sets(
        hand: Hand,
        field: Field,
        obj: Object,
        params: AdjustValues,
        it: wp.int32,
        moved_out: Candidates,
        sets_out: Adjusted,
    ):
        """One thread per set: the object's pose and the joints after a step, unless every contact is made.

        Steps (v, w, dq) := argmin sum_c (n_c . d_c + g_c + indentation)^2 + s |d_c - o_c|^2 + (lever w_n)^2 |m_c -
        m'_c|^2 + w_d sum_b (penetration of body b)^2 + damping, where d_c is how the object's point moves against the
        link's, g_c the gap, o_c the offset of the points, m_c and m'_c the changes of the normals. The object's points
        stay, the link's slide on their face. Joints of a finger depend on those of others through the object alone, so
        that each finger is eliminated on its own.

        Args:
            it: steps before this one.
            moved_out: a pose and one candidate per group for each set, S rows.
        """
        i = wp.tid()
        if sets_out.progress[i] != int(Progress.GOING):
            return
        groups = moved_out.count.shape[1]
        T = moved_out.poses.pose[i]
        palm = moved_out.poses.palm_point[i]
        w2 = _turn_weight(params)
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        V = wp.zeros(shape=(size,), dtype=wp.vec3)
        R = wp.zeros(shape=(size,), dtype=wp.vec3)
        mixed = wp.zeros(shape=(lines,), dtype=vec6)
        own = wp.zeros(shape=(MAX_GROUPS,), dtype=column)
        equations = wp.zeros(shape=(ROWS,), dtype=vec6)
        centre = wp.transform_point(T, obj.com)
        met = bool(True)
        near = bool(True)
        deepest = float(0.0)
        for g in range(groups):
            if moved_out.count[i, g] == 1:
                s = moved_out.surface[i, g, 0]
                k = field.point[moved_out.record[i, g, 0]]
                grid = hand.contacts.grid[k]
                j0 = group_forward(hand.kin, g, moved_out.q[i, g, 0], X, 0)
                body = hand.contacts.body[k] - 1 - j0
                dofs = hand.kin.dof_free[g]
                target = wp.transform_point(T, obj.contact_points[s])
                normal = -wp.transform_vector(T, obj.contact_normals[s])
                local = wp.transform_point(wp.transform_inverse(X[body]), target)
                touch = _slid(hand, grid, sets_out.touch[i, g], local)
                sets_out.touch[i, g] = touch
                n = wp.transform_vector(X[body], touch.out)
                p = wp.transform_point(X[body], touch.local)
                facing = wp.dot(n, normal)
                met = met and _made(hand, params, grid, touch, facing)
                near = near and _is_near(params, touch, facing)
                for a in range(size):
                    V[a] = wp.vec3()
                    R[a] = wp.vec3()
                j = body
                while j >= 0:
                    d = hand.kin.joint_dof[j0 + j]
                    if d < dofs:
                        v = point_column(hand.kin, j0 + j, X[j], p)
                        V[d] = V[d] - v
                        R[d] = R[d] + point_column(hand.kin, j0 + j, X[j], p + n) - v
                    j = hand.kin.joint_parent[j0 + j]
                aim = p - n * params.contact_indentation - target
                turn = normal - n
                arm = target - centre
                loose = _looseness(params, touch)
                row = motion_row(n, arm)
                A = square()
                b = column()
                for a in range(size):
                    along = wp.dot(V[a], n)
                    b[a] = along * wp.dot(n, aim) + loose * wp.dot(V[a], aim) + w2 * wp.dot(R[a], turn)
                    m = w2 * wp.cross(R[a], normal)
                    mixed[g * size + a] = along * row + loose * motion_row(V[a], arm) + turn_row(m)
                    for c in range(a + 1):
                        A[a, c] = along * wp.dot(V[c], n) + loose * wp.dot(V[a], V[c]) + w2 * wp.dot(R[a], R[c])
                    A[a, a] = A[a, a] + params.damping
                _add_object_rows(equations, params, touch, p, n, target, centre, normal)
                bodies = wp.where(it < FIRST_DEPTH, 0, hand.kin.joint_first[g + 1] - j0)
                for other in range(bodies):
                    deep = deepest_of(sets_out, i, 1 + j0 + other)
                    deepest = wp.max(deepest, deep.depth)
                    aimed = deep.depth - params.left_penetration
                    if aimed > 0.0:
                        away = wp.transform_vector(T, deep.away)
                        x = wp.transform_point(T, deep.at)
                        row = -motion_row(away, x - centre)
                        J = column()
                        j = other
                        while j >= 0:
                            d = hand.kin.joint_dof[j0 + j]
                            if d < dofs:
                                J[d] = J[d] + wp.dot(point_column(hand.kin, j0 + j, X[j], x), away)
                            j = hand.kin.joint_parent[j0 + j]
                        for a in range(size):
                            weighted = params.depth_weight * J[a]
                            b[a] = b[a] + weighted * aimed
                            mixed[g * size + a] += weighted * row
                            for c in range(a + 1):
                                A[a, c] = A[a, c] + weighted * J[c]
                        add_distance(equations, row, aimed, params.depth_weight)
                eliminate(A, b, mixed, own, g, equations)
        if palm >= 0:
            target = wp.transform_point(T, obj.contact_points[moved_out.poses.palm_surface[i]])
            normal = -wp.transform_vector(T, obj.contact_normals[moved_out.poses.palm_surface[i]])
            touch = _slid(hand, hand.contacts.grid[palm], sets_out.touch[i, groups], target)
            sets_out.touch[i, groups] = touch
            _add_object_rows(equations, params, touch, touch.local, touch.out, target, centre, normal)
            met = met and _made(hand, params, hand.contacts.grid[palm], touch, wp.dot(touch.out, normal))
            near = near and _is_near(params, touch, wp.dot(touch.out, normal))
        if it >= FIRST_DEPTH:
            deep = deepest_of(sets_out, i, 0)
            deepest = wp.max(deepest, deep.depth)
            aimed = deep.depth - params.left_penetration
            if aimed > 0.0:
                row = -motion_row(wp.transform_vector(T, deep.away), wp.transform_point(T, deep.at) - centre)
                add_distance(equations, row, aimed, params.depth_weight)
        if met and sets_out.both[i] == 1 and deepest <= params.max_penetration:
            sets_out.progress[i] = int(Progress.WHOLE)
            return
        given_up = it >= params.patience and (not near or deepest > _NEAR_DEPTH)
        if given_up or it == params.iterations:
            sets_out.progress[i] = int(Progress.GIVEN_UP)
            return
        if met or it + 1 >= _FIRST_BOTH:
            sets_out.both[i] = 1
        motion = solve_motion(equations, params.object_damping, params.lever)
        motion, T = moved_pose(T, obj.com, motion, params.object_step, params.object_turn)
        moved_out.poses.pose[i] = T
        for g in range(groups):
            if moved_out.count[i, g] == 1:
                q = moved_out.q[i, g, 0]
                for a in range(size):
                    if a < hand.kin.dof_free[g]:
                        moved = own[g][a] - wp.dot(mixed[g * size + a], motion)
                        q[a] = q[a] + wp.clamp(moved, -params.step, params.step)
                moved_out.q[i, g, 0] = clamp_dofs(hand.kin, g, q)

    return step_sets


step_sets = {size: _stepping(size) for size in DOF_SIZES}
"""Kernels by the most dofs of a group."""


@wp.kernel
def check_thumbs(hand: Hand, moved: Candidates, sets: Adjusted, whole_out: wp.array(dtype=wp.int32)):
    """Which sets are whole, the thumb where it has to be.

    Args:
        whole_out: 1 or 0, (S,).
    """
    i = wp.tid()
    whole = sets.progress[i] == int(Progress.WHOLE)
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    for g in range(moved.count.shape[1]):
        if whole and moved.count[i, g] == 1:
            group_forward(hand.kin, g, moved.q[i, g, 0], X, 0)
            whole = thumb_placed(hand, g, X, 0)
    whole_out[i] = wp.where(whole, 1, 0)


@wp.kernel
def take_whole(upto: wp.array(dtype=wp.int32), sets: Sets, taken_out: Sets, counts_out: wp.array(dtype=wp.int32)):
    """The sets whose contacts are made; each has a pose of its own.

    Args:
        upto: how many of the first ``s + 1`` sets are whole, (S,).
        counts_out: AdjustCount, (2,).
    """
    s = wp.tid()
    if s == upto.shape[0] - 1:
        taken_out.rows[0] = upto[s]
        counts_out[int(AdjustCount.TRIED)] = upto.shape[0]
        counts_out[int(AdjustCount.KEPT)] = upto[s]
    before = int(0)
    if s > 0:
        before = upto[s - 1]
    if upto[s] > before:
        taken_out.pose[before] = s
        taken_out.slot[before] = sets.slot[s]
        taken_out.score[before] = sets.score[s]
        for g in range(sets.chosen.shape[1]):
            taken_out.chosen[before, g] = wp.where(sets.chosen[s, g] >= 0, 0, -1)

"""Kernels of the ik stage: contacts are realised finger by finger; of sets the whole ones are kept."""

from enum import IntEnum
from typing import Any

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.collision import body_clear, finger_above, resting_plane
from lgrasp.grasp.held import Held, body_clear_of_held, group_fixed
from lgrasp.grasp.structs import Candidates, Sets, State
from lgrasp.hand.arrays import Hand, contact_allowed, thumb_placed
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.cholesky import solving
from lgrasp.math.kinematics import clamp_dofs, group_forward, point_column
from lgrasp.math.limits import DOF_SIZES, MAX_JOINTS
from lgrasp.math.sdf import sdf_gradient, sdf_of
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import params_struct
from lgrasp.runtime.unrolled import unrolled
from lgrasp.stages.ik.params import IkParams

wp.set_module_options(KERNEL_OPTIONS)

_EARLY_GAP = wp.constant(0.25)  # share of the allowed gap at which iteration stops, if the normals agree as well


class IkCount(IntEnum):
    """Counts of the stage; SETS of contact sets only."""

    TRIED = 0
    REACHED = 1
    KEPT = 2
    SETS = 3


IkValues = params_struct(
    "IkValues", __name__, IkParams, floats="cosine allowed_penetration min_self_distance min_table_distance"
)
"""IkParams and GraspBounds as kernels read them; ``cosine``: least of the normals."""


def _realising(size: int) -> Any:
    """The kernel for groups of at most ``size`` dofs: what is known to the compiler stays in registers."""
    square, column, solve = wp.types.matrix((size, size), wp.float32), wp.types.vector(size, wp.float32), solving(size)

    @unrolled
    @wp.kernel
    def realise_contacts(
        hand: Hand,
        field: Field,
        obj: Object,
        held: Held,
        params: IkValues,
        wanted: wp.array3d(dtype=wp.int32),
        candidates_out: Candidates,
        counts_out: wp.array(dtype=wp.int32),
    ):
        """Joint positions that put a contact on the object, and whether they do (Lightning Grasp, eq. 7, 5.5).

        Steps dq := argmin |J1 dq - e1|^2 + w^2 |J2 dq - e2|^2 + damping |dq|^2, where e1 = p_o - p and
        e2 = e1 + lever (n_o - n), p and n are the hand's contact, n_o the inward normal of the object's, and p_o lies
        ``contact_indentation`` in the object. After each, p slides to the point of the link nearest to the object's.
        ``candidates_out.q`` holds the seed on entry; its frozen dofs (:class:`Held`) do not move.

        Args:
            wanted: 0 leaves a candidate alone, (P, G, M).
            counts_out: IkCount, (3,) or (4,).
        """
        row, g, m = wp.tid()
        if (
            m >= candidates_out.count[row, g]
            or wanted[row, g, m] == 0
            or candidates_out.state[row, g, m] != State.DRAWN
        ):
            return
        T = candidates_out.poses.pose[row]
        s = candidates_out.surface[row, g, m]
        target = wp.transform_point(T, obj.contact_points[s])
        normal = -wp.transform_vector(T, obj.contact_normals[s])
        c = field.point[candidates_out.record[row, g, m]]
        grid = hand.contacts.grid[c]
        sdf = sdf_of(hand.contacts.grids, grid)
        j0 = hand.kin.joint_first[g]
        body = hand.contacts.body[c] - 1 - j0
        dofs = hand.kin.dof_free[g]
        still = held.frozen[candidates_out.poses.index[row] // held.tries, g]
        q = candidates_out.q[row, g, m]
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        point = hand.contacts.points[c]
        out = hand.contacts.normals[c]
        gap = float(1.0)
        dot = float(0.0)
        w2 = params.normal_weight * params.normal_weight
        for it in range(params.iterations + 1):
            group_forward(hand.kin, g, q, X, 0)
            B = X[body]
            if it > 0:
                # the contact slides: nearest point of the link surface to the target
                local = wp.transform_point(wp.transform_inverse(B), target)
                e = sdf_gradient(sdf, local)
                out = wp.vec3(e[0], e[1], e[2])
                point = local - out * e[3]
                gap = e[3]
            n = wp.transform_vector(B, out)
            dot = wp.dot(n, normal)
            difference = wp.abs(gap + params.contact_indentation)
            if it > 0 and difference < _EARLY_GAP * params.gap and dot > 0.5 * (1.0 + params.cosine):
                break
            if it == params.iterations:
                break
            p = wp.transform_point(B, point)
            e1 = target + normal * params.contact_indentation - p
            e2 = e1 + (normal - n) * params.lever
            A = square()
            b = column()
            J1 = wp.zeros(shape=(size,), dtype=wp.vec3)
            J2 = wp.zeros(shape=(size,), dtype=wp.vec3)
            j = body
            while j >= 0:
                d = hand.kin.joint_dof[j0 + j]
                J1[d] = J1[d] + point_column(hand.kin, j0 + j, X[j], p)
                J2[d] = J2[d] + point_column(hand.kin, j0 + j, X[j], p + n * params.lever)
                j = hand.kin.joint_parent[j0 + j]
            for a in range(wp.static(size)):
                if a >= dofs or ((still >> a) & 1) == 1:
                    J1[a] = wp.vec3(0.0)
                    J2[a] = wp.vec3(0.0)
                b[a] = wp.dot(J1[a], e1) + w2 * wp.dot(J2[a], e2)
                for k in range(wp.static(a + 1)):
                    A[a, wp.static(k)] = wp.dot(J1[a], J1[k]) + w2 * wp.dot(J2[a], J2[k])
                A[a, a] = A[a, a] + params.damping
            step = solve(A, b, size, 0.0, 1.0e-12)
            for a in range(wp.static(size)):
                q[wp.static(a)] = q[a] + wp.clamp(step[a], -params.step, params.step)
            q = clamp_dofs(hand.kin, g, q)
        state = int(State.REALISED)
        if wp.abs(gap + params.contact_indentation) > params.gap or dot < params.cosine:
            state = State.MISSED
        if state == State.REALISED and not contact_allowed(hand.contacts, grid, out):
            state = State.MISSED
        if state == State.REALISED and not thumb_placed(hand, g, X, 0):
            state = State.MISSED
        if state == State.REALISED and params.check_collision == 1:
            T_object = wp.transform_inverse(T)
            # the touching body first: it fails most often
            joints = hand.kin.joint_first[g + 1] - j0
            for k in range(joints):
                j = (body + joints - k) % joints
                T = T_object * X[j]
                if state == State.REALISED and not body_clear(hand, obj, 1 + j0 + j, T, params.allowed_penetration):
                    state = State.BLOCKED
        if state == State.REALISED and obj.resting.count > 0:
            plane = resting_plane(obj, candidates_out.poses.pose[row], candidates_out.poses.resting[row])
            if not finger_above(hand, g, X, plane, params.min_table_distance):
                state = State.BLOCKED
        candidates_out.q[row, g, m] = q
        candidates_out.state[row, g, m] = state
        wp.atomic_add(counts_out, IkCount.TRIED, 1)
        if state != State.MISSED:
            wp.atomic_add(counts_out, IkCount.REACHED, 1)
        if state == State.REALISED:
            wp.atomic_add(counts_out, IkCount.KEPT, 1)

    return realise_contacts


realise_contacts = {size: _realising(size) for size in DOF_SIZES}
"""Kernels by the most dofs of a group."""


@wp.kernel
def avoid_held(
    hand: Hand, held: Held, params: IkValues, candidates_out: Candidates, counts_out: wp.array(dtype=wp.int32)
):
    """Realised candidates whose finger meets a held object, or a finger that stays as it is, are blocked.

    Args:
        counts_out: IkCount, (3,) or (4,).
    """
    row, g, m = wp.tid()
    if m >= candidates_out.count[row, g] or candidates_out.state[row, g, m] != State.REALISED:
        return
    h = candidates_out.poses.index[row] // held.tries
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Y = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = group_forward(hand.kin, g, candidates_out.q[row, g, m], X, 0)
    clear = bool(True)
    for j in range(hand.kin.joint_first[g + 1] - j0):
        if clear:
            clear = body_clear_of_held(hand, held, h, 1 + j0 + j, X[j], params.min_held_distance)
    for f in range(hand.kin.groups):
        if clear and f != g and group_fixed(hand, held, h, f):
            group_forward(hand.kin, f, held.posture[h, f], Y, 0)
            if f < g:
                clear = group_pairs_clear(hand, f + 1, g + 1, Y, 0, X, 0, params.min_self_distance)
            else:
                clear = group_pairs_clear(hand, g + 1, f + 1, X, 0, Y, 0, params.min_self_distance)
    if not clear:
        candidates_out.state[row, g, m] = State.BLOCKED
        wp.atomic_sub(counts_out, IkCount.KEPT, 1)


@wp.kernel
def mark_chosen(sets: Sets, wanted_out: wp.array3d(dtype=wp.int32)):
    """1 at every candidate that a set has chosen.

    Args:
        wanted_out: (P, G, M), zeros on entry.
    """
    i = wp.tid()
    if i >= sets.rows[0]:
        return
    for g in range(sets.chosen.shape[1]):
        if sets.chosen[i, g] >= 0:
            wanted_out[sets.pose[i], g, sets.chosen[i, g]] = 1


@wp.kernel
def flag_realised(sets: Sets, candidates: Candidates, whole_out: wp.array(dtype=wp.int32)):
    """1 for sets whose every contact was realised, else 0.

    Args:
        whole_out: (S,).
    """
    i = wp.tid()
    whole_out[i] = 0
    if i >= sets.rows[0]:
        return
    for g in range(sets.chosen.shape[1]):
        m = sets.chosen[i, g]
        if m >= 0 and candidates.state[sets.pose[i], g, wp.max(m, 0)] != State.REALISED:
            return
    whole_out[i] = 1


@wp.kernel
def take_realised(upto: wp.array(dtype=wp.int32), sets: Sets, whole_out: Sets, counts_out: wp.array(dtype=wp.int32)):
    """The whole sets.

    Args:
        upto: how many of the first ``s + 1`` sets are whole, (S,).
        counts_out: IkCount, (4,).
    """
    s = wp.tid()
    if s == upto.shape[0] - 1:
        whole_out.rows[0] = upto[s]
        counts_out[int(IkCount.SETS)] = upto[s]
    before = int(0)
    if s > 0:
        before = upto[s - 1]
    if upto[s] > before:
        whole_out.pose[before] = sets.pose[s]
        whole_out.slot[before] = sets.slot[s]
        whole_out.score[before] = sets.score[s]
        for g in range(sets.chosen.shape[1]):
            whole_out.chosen[before, g] = sets.chosen[s, g]

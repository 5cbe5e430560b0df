"""Kernels of the squeeze: joint targets that press, and how far they go; and where contacts come off the object."""

import warp as wp

from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places
from lgrasp.grasp.outcomes import PINCH, Outcome
from lgrasp.hand.arrays import Hand
from lgrasp.math.cholesky import mat_dof, solve_dofs
from lgrasp.math.constants import SLIDING_ARM
from lgrasp.math.kinematics import clamp_dofs, group_forward, point_column, vec_dof
from lgrasp.math.limits import MAX_CONTACTS, MAX_DOFS, MAX_JOINTS
from lgrasp.math.transforms import transforms, vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_LEAST_FORCE = wp.constant(1.0e-6)  # [N]
_SHIFT_STEPS = wp.constant(3)
_SHIFT_DAMPING = wp.constant(1.0e-4)  # [m2/rad2]
_SHIFT_STEP = wp.constant(0.4)  # [rad or m] of a joint, at most
_TINY = wp.constant(1.0e-12)
_WEAK = wp.constant(0.999)  # share of a force below which effort limits keep the hand from it


@wp.func
def shift_contact(hand: Hand, g: wp.int32, q0: vec_dof, j: wp.int32, point: wp.vec3, by: wp.vec3):
    """Joint positions that move a point of the group's body j by ``by`` [m] (three damped steps), limits kept."""
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_free[g]
    q = q0
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    target = wp.vec3(0.0)
    for it in range(_SHIFT_STEPS):
        group_forward(hand.kin, g, q, X, 0)
        p = wp.transform_point(X[j], point)
        if it == 0:
            target = p + by
        e = target - p
        J = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
        a = j
        while a >= 0:
            d = hand.kin.joint_dof[j0 + a]
            J[d] = J[d] + point_column(hand.kin, j0 + a, X[a], p)
            a = hand.kin.joint_parent[j0 + a]
        # damped right inverse: dq = J^T (J J^T + c I)^-1 e
        A = wp.identity(n=3, dtype=wp.float32) * _SHIFT_DAMPING
        for d in range(dofs):
            A = A + wp.outer(J[d], J[d])
        y = wp.inverse(A) * e
        for d in range(dofs):
            q[d] = q[d] + wp.clamp(wp.dot(J[d], y), -_SHIFT_STEP, _SHIFT_STEP)
        q = clamp_dofs(hand.kin, g, q)
    return q


@wp.func
def back_off(
    hand: Hand,
    g: wp.int32,
    q0: vec_dof,
    contacts: wp.int32,
    body: wp.array(dtype=wp.int32),
    points: vec3s,
    normals: vec3s,
    distance: wp.float32,
):
    """Joint positions that move points of several bodies of a group by ``distance`` [m] along their normals, as well as
    its joints can together (damped steps), limits kept.

    Args:
        body: of each contact, counted within the group.
        points: in its frame [m].
        normals: in the hand's frame.
    """
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_free[g]
    q = q0
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    goal = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.float32)
    for it in range(_SHIFT_STEPS):
        group_forward(hand.kin, g, q, X, 0)
        A = mat_dof()
        b = vec_dof()
        for c in range(contacts):
            p = wp.transform_point(X[body[c]], points[c])
            at = wp.dot(p, normals[c])
            if it == 0:
                goal[c] = at + distance
            J = vec_dof()
            a = body[c]
            while a >= 0:
                d = hand.kin.joint_dof[j0 + a]
                if d < dofs:
                    J[d] = J[d] + wp.dot(point_column(hand.kin, j0 + a, X[a], p), normals[c])
                a = hand.kin.joint_parent[j0 + a]
            b += J * (goal[c] - at)
            A += wp.outer(J, J)
        step = solve_dofs(A, b, dofs, _SHIFT_DAMPING, _TINY)
        for d in range(dofs):
            q[d] = q[d] + wp.clamp(step[d], -_SHIFT_STEP, _SHIFT_STEP)
        q = clamp_dofs(hand.kin, g, q)
    return q


@wp.func
def joint_lead(hand: Hand, k: wp.int32, T: wp.transform, p: wp.vec3, f: wp.vec3, stiffness: wp.float32):
    """How far ahead position control of joint k's dof must aim to press with force f [N] on point p of a body that it
    moves (body frame T of the joint) [rad or m]."""
    lead = wp.dot(point_column(hand.kin, k, T, p), f) / stiffness
    return wp.where(hand.kin.drive_prismatic[k] == 1, lead * SLIDING_ARM * SLIDING_ARM, lead)


@wp.func
def press_contact(
    hand: Hand, g: wp.int32, q0: vec_dof, j: wp.int32, body: transforms, p: wp.vec3, f: wp.vec3, k: wp.float32
):
    """q + J^T f / stiffness: targets of a group's own dofs that press with force f [N] on point p of body j, limits or
    not."""
    j0 = hand.kin.joint_first[g]
    q = q0
    a = j
    while a >= 0:
        d = hand.kin.joint_dof[j0 + a]
        if d < hand.kin.dof_free[g]:
            q[d] = q[d] + joint_lead(hand, j0 + a, body[j0 + a], p, f, k)
        a = hand.kin.joint_parent[j0 + a]
    return q


@wp.kernel
def control_poses(
    hand: Hand,
    limits: Limits,
    places: Places,
    at: CheckedPostures,
    found: Findings,
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
    opened_out: wp.array3d(dtype=vec_dof),
):
    """One thread per (row kept, group): q, q that presses, and the postures with its first contact, and with all of
    them, off the object; the second is q where there is one contact.

    The squeeze presses with the balancing forces, ``squeeze_force`` [N] in all along the normals.

    Args:
        row: (m,) hand of each row, -1 none.
        opened_out: (m, G, 2) [rad or m].
    """
    i, g = wp.tid()
    s = row[i]
    if s < 0:
        return
    x = at.posture[s, g]
    opened = x
    body = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.int32)
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    pressed = x
    contacts = int(0)
    j0 = hand.kin.joint_first[g]
    for k in range(at.contact.shape[1]):
        c = at.contact[s, k]
        if c >= 0:
            b = places.body[c]
            if b > j0 and b <= hand.kin.joint_first[g + 1]:
                T = at.pose[at.of[s]]
                p = wp.transform_point(T, places.points[at.surface[s, k]])
                f = wp.transform_vector(T, found.force[s, k]) * limits.squeeze_force
                target = press_contact(hand, g, x, b - 1 - j0, at.body[s], p, f, limits.squeeze_stiffness)
                body[contacts] = b - 1 - j0
                points[contacts] = wp.transform_point(wp.transform_inverse(at.body[s, b - 1]), p)
                normals[contacts] = wp.transform_vector(T, places.normals[at.surface[s, k]])
                if contacts == 0:
                    opened = shift_contact(hand, g, x, body[0], points[0], normals[0] * limits.pregrasp_distance)
                    pressed = target
                else:
                    pressed = pressed + target - x
                contacts += 1
    first = hand.kin.dof_first[g]
    for d in range(hand.kin.dof_first[g + 1] - first):
        column = hand.kin.dof_index[first + d]
        packed_out.q[i, column] = x[d]
        packed_out.q_squeeze[i, column] = pressed[d]
    opened_out[i, g, 0] = opened
    freed = x
    if contacts > 1:
        freed = back_off(hand, g, x, contacts, body, points, normals, limits.pregrasp_distance)
    opened_out[i, g, 1] = freed


@wp.kernel
def press_shared(
    hand: Hand,
    limits: Limits,
    places: Places,
    at: CheckedPostures,
    found: Findings,
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
):
    """One thread per row kept: joints that groups share press as well, with what all contacts ask of them.

    Args:
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    T = at.pose[at.of[s]]
    for c in range(at.contact.shape[1]):
        if at.contact[s, c] >= 0:
            b = places.body[at.contact[s, c]]
            g = hand.body_group[b]
            p = wp.transform_point(T, places.points[at.surface[s, c]])
            f = wp.transform_vector(T, found.force[s, c]) * limits.squeeze_force
            k = b - 1
            while g >= 0 and k >= hand.kin.joint_first[wp.max(g, 0)]:
                d = hand.kin.joint_dof[k]
                if d >= hand.kin.dof_free[g]:
                    column = hand.kin.dof_index[hand.kin.dof_first[g] + d]
                    lead = joint_lead(hand, k, at.body[s, k], p, f, limits.squeeze_stiffness)
                    packed_out.q_squeeze[i, column] = packed_out.q_squeeze[i, column] + lead
                k = wp.where(hand.kin.joint_parent[k] < 0, -1, hand.kin.joint_parent[k] + hand.kin.joint_first[g])


@wp.func
def _column_stiffness(hand: Hand, limits: Limits, column: wp.int32):
    """Of the position control of a column of q [N m/rad or N/m]."""
    arm = wp.where(hand.kin.column_sliding[column] == 1, SLIDING_ARM, 1.0)
    return limits.squeeze_stiffness / (arm * arm)


@wp.func
def _stable_share(limits: Limits, packed: Packed, i: wp.int32):
    """Of ``squeeze_force`` that is ``squeeze_margin`` below what is stable, 1 at most."""
    most = limits.squeeze_margin * limits.squeeze_force
    return wp.where(most > packed.stable_squeeze[i], packed.stable_squeeze[i] / most, 1.0)


@wp.kernel
def limit_squeeze(hand: Hand, limits: Limits, row: wp.array(dtype=wp.int32), packed_out: Packed):
    """Targets of the squeeze within joint limits; where its force would be nearer to the stable one than
    ``squeeze_margin``, or a joint would exceed its effort limit, all forces of the hand shrink alike. And how far that
    takes the contacts, mean by force, if the object gives way.

    Args:
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    if row[i] < 0:
        return
    share = _stable_share(limits, packed_out, i)
    for c in range(packed_out.q.shape[1]):
        effort = wp.abs(packed_out.q_squeeze[i, c] - packed_out.q[i, c]) * _column_stiffness(hand, limits, c)
        if share * effort > hand.kin.column_effort[c]:
            share = hand.kin.column_effort[c] / effort
    work = float(0.0)
    for c in range(packed_out.q.shape[1]):
        q = packed_out.q[i, c]
        wanted = q + (packed_out.q_squeeze[i, c] - q) * share
        target = wp.clamp(wanted, hand.kin.column_lower[c], hand.kin.column_upper[c])
        work += _column_stiffness(hand, limits, c) * (wanted - q) * (target - q)
        packed_out.q_squeeze[i, c] = target
    packed_out.squeeze_force[i] = share * limits.squeeze_force
    packed_out.squeeze_travel[i] = work / wp.max(share * limits.squeeze_force, _LEAST_FORCE)


@wp.kernel
def drop_limp(limits: Limits, packed: Packed, row_out: wp.array(dtype=wp.int32), counts_out: wp.array(dtype=wp.int32)):
    """Rows that squeeze the object by less than ``min_squeeze_travel``, or cannot stably with ``min_stable_squeeze``
    (of two contacts: ``min_stable_pinch``), or close by more than ``max_closing_travel``, or through more of the object
    than ``max_closing_penetration`` or farther than ``max_closing_sweep``, or have less than ``min_epsilon``, or a
    contact that bears less than ``min_force_share``, or a finger that opens by less than ``min_pregrasp_opening``,
    become none.

    Args:
        row_out: (m,) hand of each row, -1 none.
        counts_out: (reasons,) these rows are moved from those that are kept; WEAK are those that squeeze too little
            as a joint's effort limit has it.
    """
    i = wp.tid()
    if row_out[i] < 0:
        return
    contacts = int(0)
    whole = float(0.0)
    least = float(1.0e30)
    for c in range(packed.contact_links.shape[1]):
        if packed.contact_links[i, c] >= 0:
            push = -wp.dot(packed.contact_forces[i, c], packed.contact_normals[i, c])
            whole += push
            least = wp.min(least, push)
            contacts += 1
    uneven = least < limits.min_force_share * whole
    stable = limits.min_stable_squeeze
    if contacts == PINCH:
        stable = wp.max(stable, limits.min_stable_pinch)
    limp = packed.squeeze_travel[i] < limits.min_squeeze_travel
    soft = packed.stable_squeeze[i] < stable
    still = packed.pregrasp_opening[i] < limits.min_pregrasp_opening
    far = packed.closing_travel[i] > limits.max_closing_travel
    through = packed.closing_penetration[i] > limits.max_closing_penetration
    through = through or packed.closing_sweep[i] > limits.max_closing_sweep
    if limp or soft or still or far or through or uneven or packed.epsilon[i] < limits.min_epsilon:
        row_out[i] = -1
        wp.atomic_sub(counts_out, Outcome.KEPT, 1)
        wanted = _stable_share(limits, packed, i) * limits.squeeze_force
        if limp and packed.squeeze_force[i] < _WEAK * wanted:
            wp.atomic_add(counts_out, Outcome.WEAK, 1)
        else:
            wp.atomic_add(counts_out, Outcome.SQUEEZE, 1)

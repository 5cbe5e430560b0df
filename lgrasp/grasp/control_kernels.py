"""Kernels of the control poses: the hand opened before the grasp, and joint targets that press."""

import warp as wp

from lgrasp.grasp.check_kernels import hand_pairs_clear
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places
from lgrasp.grasp.collision import body_apart, body_height, resting_plane
from lgrasp.grasp.held import Held, body_clear_of_held
from lgrasp.grasp.outcomes import KEPT, SQUEEZE
from lgrasp.hand.arrays import Hand
from lgrasp.math.constants import SLIDING_ARM
from lgrasp.math.kinematics import clamp_dofs, group_forward, point_column, vec_dof
from lgrasp.math.limits import MAX_BODIES, MAX_DOFS, MAX_JOINTS
from lgrasp.math.transforms import transforms
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_ARM = wp.constant(SLIDING_ARM)
_LEAST_FORCE = wp.constant(1.0e-6)  # [N]
_OPENING_SHARES = wp.constant(5)  # of the way open that are tried
FINGER_TRIES = wp.constant(2 * _OPENING_SHARES)
"""Postures of a finger that is opened by itself."""
_NOT_TOUCHING = wp.constant(1.0e6)  # opening of a hand no finger of which touches


@wp.func
def shift_contact(hand: Hand, g: wp.int32, q0: vec_dof, j: wp.int32, point: wp.vec3, by: wp.vec3):
    """Joint positions that move a point of the group's body j by ``by`` [m] (three damped steps), limits kept."""
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_free[g]
    q = q0
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    target = wp.vec3(0.0)
    for it in range(3):
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
        A = wp.identity(n=3, dtype=wp.float32) * 1.0e-4
        for d in range(dofs):
            A = A + wp.outer(J[d], J[d])
        y = wp.inverse(A) * e
        for d in range(dofs):
            q[d] = q[d] + wp.clamp(wp.dot(J[d], y), -0.4, 0.4)
        q = clamp_dofs(hand.kin, g, q)
    return q


@wp.func
def joint_lead(hand: Hand, k: wp.int32, T: wp.transform, p: wp.vec3, f: wp.vec3, stiffness: wp.float32):
    """How far ahead position control of joint k's dof must aim to press with force f [N] on point p of a body that it
    moves (body frame T of the joint) [rad or m]."""
    lead = wp.dot(point_column(hand.kin, k, T, p), f) / stiffness
    return wp.where(hand.kin.joint_prismatic[k] == 1, lead * _ARM * _ARM, lead)


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
    opened_out: wp.array2d(dtype=vec_dof),
):
    """One thread per (row kept, group): q, q that presses, and the posture with its first contact off the object.

    The squeeze presses with the balancing forces, ``squeeze_force`` [N] in all along the normals.

    Args:
        row: (m,) hand of each row, -1 none.
        opened_out: (m, G) [rad or m].
    """
    i, g = wp.tid()
    s = row[i]
    if s < 0:
        return
    x = at.posture[s, g]
    opened = x
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
                if contacts == 0:
                    n = wp.transform_vector(T, places.normals[at.surface[s, k]])
                    local = wp.transform_point(wp.transform_inverse(at.body[s, b - 1]), p)
                    opened = shift_contact(hand, g, x, b - 1 - j0, local, n * limits.pregrasp_distance)
                    pressed = target
                else:
                    pressed = pressed + target - x
                contacts += 1
    first = hand.kin.dof_first[g]
    for d in range(hand.kin.dof_first[g + 1] - first):
        column = hand.kin.dof_index[first + d]
        packed_out.q[i, column] = x[d]
        packed_out.q_squeeze[i, column] = pressed[d]
    opened_out[i, g] = opened


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


@wp.kernel
def limit_squeeze(hand: Hand, limits: Limits, row: wp.array(dtype=wp.int32), packed_out: Packed):
    """Targets of the squeeze within joint limits; where one is further ahead than ``max_squeeze_lead``, all forces of
    the hand shrink alike. And how far that takes the contacts, mean by force, if the object gives way.

    Args:
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    if row[i] < 0:
        return
    lead = float(0.0)
    work = float(0.0)
    for c in range(packed_out.q.shape[1]):
        q = packed_out.q[i, c]
        wanted = packed_out.q_squeeze[i, c]
        target = wp.clamp(wanted, hand.kin.column_lower[c], hand.kin.column_upper[c])
        arm = wp.where(hand.kin.column_sliding[c] == 1, _ARM, 1.0)
        work += limits.squeeze_stiffness * (wanted - q) * (target - q) / (arm * arm)
        lead = wp.max(lead, wp.abs(target - q) / arm)
        packed_out.q_squeeze[i, c] = target
    share = float(1.0)
    if lead > limits.max_squeeze_lead:
        share = limits.max_squeeze_lead / lead
        for c in range(packed_out.q.shape[1]):
            q = packed_out.q[i, c]
            packed_out.q_squeeze[i, c] = q + (packed_out.q_squeeze[i, c] - q) * share
    packed_out.squeeze_travel[i] = share * work / wp.max(limits.squeeze_force, _LEAST_FORCE)


@wp.kernel
def drop_limp(limits: Limits, packed: Packed, row_out: wp.array(dtype=wp.int32), counts_out: wp.array(dtype=wp.int32)):
    """Rows that squeeze the object by less than ``min_squeeze_travel`` become none.

    Args:
        row_out: (m,) hand of each row, -1 none.
        counts_out: (reasons,) these rows are moved from those that are kept.
    """
    i = wp.tid()
    if row_out[i] >= 0 and packed.squeeze_travel[i] < limits.min_squeeze_travel:
        row_out[i] = -1
        wp.atomic_sub(counts_out, KEPT, 1)
        wp.atomic_add(counts_out, SQUEEZE, 1)


@wp.func
def finger_clear(
    hand: Hand,
    obj: Object,
    held: Held,
    limits: Limits,
    h: wp.int32,
    g: wp.int32,
    T: wp.transform,
    pose: wp.int32,
    X: wp.array(dtype=wp.transform),
):
    """1 if the bodies of a finger are off the object at T, its table and what is held; X[j] = pose of body 1 + j."""
    T_object = wp.transform_inverse(T)
    plane = resting_plane(obj, T, pose)
    above = limits.min_table_distance
    clear = int(1)
    for k in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
        if clear == 1 and not body_apart(hand, obj, 1 + k, T_object * X[k], limits.min_pregrasp_distance):
            clear = 0
        if clear == 1 and body_height(hand.pieces, 1 + k, X[k], plane, above) < above:
            clear = 0
        if clear == 1 and not body_clear_of_held(hand, held, h, 1 + k, X[k], limits.min_self_distance):
            clear = 0
    return clear


@wp.func
def put_pregrasp(hand: Hand, g: wp.int32, x: vec_dof, q: vec_dof, i: wp.int32, packed_out: Packed):
    """Store how a finger is opened in row i; the largest motion of its joints from q [rad or m]."""
    first = hand.kin.dof_first[g]
    moved = float(0.0)
    for d in range(hand.kin.dof_first[g + 1] - first):
        packed_out.q_pregrasp[i, hand.kin.dof_index[first + d]] = x[d]
        moved = wp.max(moved, wp.abs(x[d] - q[d]))
    return moved


@wp.kernel
def open_poses(
    hand: Hand,
    obj: Object,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array2d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
    stuck_out: wp.array(dtype=wp.int32),
):
    """The touching fingers as far open as leaves them apart from the objects and the rest of the hand.

    Shares of the way from q to ``opened`` are tried from all of it down; when none is clear the row is listed.

    Args:
        opened: (m, G) [rad or m].
        row: (m,) hand of each row, -1 none.
        stuck_out: (1 + m,) how many rows are listed, and these.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    h = at.index[at.of[s]] // held.tries
    G = hand.kin.groups
    T = at.pose[at.of[s]]
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    share = float(1.0)
    for t in range(_OPENING_SHARES):
        share = 1.0 - float(t) / float(_OPENING_SHARES)
        clear = int(1)
        for g in range(G):
            x = at.posture[s, g] + share * (opened[i, g] - at.posture[s, g])
            group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
            if clear == 1 and at.chosen[s, g] >= 0:
                clear = finger_clear(hand, obj, held, limits, h, g, T, at.resting[at.of[s]], X)
        for b in range(G):
            for a in range(b + 2):
                moves = wp.where(at.chosen[s, b] >= 0 or (a > 0 and at.chosen[s, wp.max(a - 1, 0)] >= 0), 1, 0)
                if clear * moves == 1 and not hand_pairs_clear(hand, a, b + 1, X, limits.min_self_distance):
                    clear = 0
        if clear == 1:
            break
        share = 0.0
    if share == 0.0:
        stuck_out[1 + wp.atomic_add(stuck_out, 0, 1)] = i
        return
    least = float(_NOT_TOUCHING)
    for g in range(G):
        x = at.posture[s, g] + share * (opened[i, g] - at.posture[s, g])
        moved = put_pregrasp(hand, g, x, at.posture[s, g], i, packed_out)
        if at.chosen[s, g] >= 0:
            least = wp.min(least, moved)
    packed_out.pregrasp_opening[i] = wp.where(least == _NOT_TOUCHING, 0.0, least)


@wp.func
def opened_finger(hand: Hand, held: Held, h: wp.int32, g: wp.int32, t: wp.int32, q: vec_dof, opened: vec_dof):
    """A finger on its way from q to ``opened``, from all of it down, then on its way to the hand's open posture."""
    away = opened - q
    part = 1.0 - float(t) / float(_OPENING_SHARES)
    if t >= _OPENING_SHARES:
        away = held.posture[h, g] - q
        for d in range(hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]):
            if d >= hand.kin.dof_free[g] or (held.frozen[h, g] >> d) & 1 == 1:
                away[d] = 0.0
        part = float(t + 1) / float(_OPENING_SHARES) - 1.0
    return q + part * away


@wp.kernel
def try_fingers(
    hand: Hand,
    obj: Object,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array2d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    stuck: wp.array(dtype=wp.int32),
    clear_out: wp.array2d(dtype=wp.int32),
):
    """One thread per (row listed, group, try): is the finger off the object and what is held?

    Args:
        opened: (m, G) [rad or m].
        row: (m,) hand of each row, -1 none.
        stuck: (1 + m,) how many rows are listed, and these.
        clear_out: (m, G) bit t: try t is; of zeros.
    """
    k, g, t = wp.tid()
    if k >= stuck[0]:
        return
    i = stuck[1 + k]
    s = row[i]
    if at.chosen[s, g] < 0:
        return
    h = at.index[at.of[s]] // held.tries
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    x = opened_finger(hand, held, h, g, t, at.posture[s, g], opened[i, g])
    group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
    r = at.of[s]
    if finger_clear(hand, obj, held, limits, h, g, at.pose[r], at.resting[r], X) == 1:
        wp.atomic_or(clear_out, k, g, 1 << t)


@wp.kernel
def open_fingers(
    hand: Hand,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array2d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    stuck: wp.array(dtype=wp.int32),
    clear: wp.array2d(dtype=wp.int32),
    packed_out: Packed,
):
    """Each finger of the rows listed opened by itself, in turn: the first try that is clear of the hand as well, or q.

    Args:
        opened: (m, G) [rad or m].
        row: (m,) hand of each row, -1 none.
        stuck: (1 + m,) how many rows are listed, and these.
        clear: (m, G) bit t: try t is off the object and what is held.
    """
    k = wp.tid()
    if k >= stuck[0]:
        return
    i = stuck[1 + k]
    s = row[i]
    h = at.index[at.of[s]] // held.tries
    G = hand.kin.groups
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    for g in range(G):
        group_forward(hand.kin, g, at.posture[s, g], X, hand.kin.joint_first[g])
    least = float(_NOT_TOUCHING)
    for g in range(G):
        x = at.posture[s, g]
        done = wp.where(at.chosen[s, g] >= 0, 0, 1)
        for t in range(FINGER_TRIES):
            if done == 0 and (clear[k, g] >> t) & 1 == 1:
                x = opened_finger(hand, held, h, g, t, at.posture[s, g], opened[i, g])
                group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
                done = int(1)
                for b in range(G + 1):
                    low, high = wp.min(b, g + 1), wp.max(b, g + 1)
                    if done == 1 and not hand_pairs_clear(hand, low, high, X, limits.min_self_distance):
                        done = 0
        if done == 0:
            x = at.posture[s, g]
            group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
        moved = put_pregrasp(hand, g, x, at.posture[s, g], i, packed_out)
        if at.chosen[s, g] >= 0:
            least = wp.min(least, moved)
    packed_out.pregrasp_opening[i] = wp.where(least == _NOT_TOUCHING, 0.0, least)

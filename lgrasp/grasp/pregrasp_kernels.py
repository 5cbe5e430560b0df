"""Kernels of the hand that is opened before the grasp, all fingers alike or each by itself."""

import warp as wp

from lgrasp.grasp.check_kernels import hand_pairs_clear
from lgrasp.grasp.check_structs import CheckedPostures, Limits, Packed, Places
from lgrasp.grasp.collision import body_apart, body_far, body_height, obstacles_depth, resting_plane
from lgrasp.grasp.held import Held, body_clear_of_held, body_depth_in_held
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_forward, vec_dof
from lgrasp.math.limits import MAX_BODIES
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

OPENING_SHARES = wp.constant(5)
"""Shares of the way open that are tried."""
FINGER_TRIES = wp.constant(3 * OPENING_SHARES)
"""Postures of a finger that is opened by itself."""
_NOT_TOUCHING = wp.constant(1.0e6)  # opening of a hand no finger of which touches


@wp.func
def distance_off(hand: Hand, obj: Object, limits: Limits, body: wp.int32, T: wp.transform):
    """How far a body without a contact must be off the object as the hand opens [m]: where the object rests on it at
    the grasp it may stay, as deep (below 0) as at a grasp. T = T_object_body at the grasp."""
    if body_apart(hand, obj, body, T, limits.min_pregrasp_distance):
        return limits.min_pregrasp_distance
    return -limits.max_penetration


@wp.kernel
def find_distances_off(
    hand: Hand,
    obj: Object,
    limits: Limits,
    places: Places,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    off_out: wp.array2d(dtype=wp.float32),
):
    """How far each body must be off the object as the hand opens (:func:`distance_off`), one thread per (body, row).

    Args:
        row: (m,) hand of each row, -1 none.
        off_out: (m, bodies - 1) of all but the base [m].
    """
    j, i = wp.tid()
    s = row[i]
    if s < 0:
        return
    off_out[i, j] = limits.min_pregrasp_distance
    for c in range(at.contact.shape[1]):
        if at.contact[s, c] >= 0 and places.body[at.contact[s, c]] == 1 + j:
            return
    off_out[i, j] = distance_off(hand, obj, limits, 1 + j, wp.transform_inverse(at.pose[at.of[s]]) * at.body[s, j])


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
    off: wp.array(dtype=wp.float32),
):
    """1 if the bodies of a finger are off the object at T, its table and what is held, by their samples.

    Args:
        X: (bodies - 1,) X[j] = pose of body 1 + j.
        off: (bodies - 1,) how far each must be off the object [m].
    """
    T_object = wp.transform_inverse(T)
    plane = resting_plane(obj, T, pose)
    above = limits.min_table_distance
    for k in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
        if not body_apart(hand, obj, 1 + k, T_object * X[k], off[k]):
            return 0
        if body_height(hand.pieces, 1 + k, X[k], plane, above) < above:
            return 0
        if not body_clear_of_held(hand, held, h, 1 + k, X[k], limits.min_self_distance):
            return 0
    return 1


@wp.func
def joint_motion(hand: Hand, g: wp.int32, x: vec_dof, q: vec_dof):
    """Largest motion of a finger's joints from q to x [rad or m]."""
    moved = float(0.0)
    for d in range(hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]):
        moved = wp.max(moved, wp.abs(x[d] - q[d]))
    return moved


@wp.func
def put_pregrasp(hand: Hand, g: wp.int32, x: vec_dof, q: vec_dof, i: wp.int32, packed_out: Packed):
    """Store how a finger is opened in row i; the largest motion of its joints from q [rad or m]."""
    first = hand.kin.dof_first[g]
    for d in range(hand.kin.dof_first[g + 1] - first):
        packed_out.q_pregrasp[i, hand.kin.dof_index[first + d]] = x[d]
    return joint_motion(hand, g, x, q)


@wp.func
def _opened_share(q: vec_dof, opened: vec_dof, t: wp.int32):
    """A finger on its way from q to ``opened``: all of it at try 0, less at each."""
    return q + (1.0 - float(t) / float(OPENING_SHARES)) * (opened - q)


@wp.kernel
def try_openings(
    hand: Hand,
    obj: Object,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array3d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    off: wp.array2d(dtype=wp.float32),
    clear_out: wp.array(dtype=wp.int32),
):
    """One thread per (try, row): are the touching fingers, that far open, apart from the objects and the rest of the
    hand? Rows known to be clear when farther open are left alone.

    Args:
        opened: (m, G, 2) of :func:`~lgrasp.grasp.control_kernels.control_poses`.
        row: (m,) hand of each row, -1 none.
        off: (m, bodies - 1) of :func:`find_distances_off` [m].
        clear_out: (m,) bit t: try t is; of zeros.
    """
    t, i = wp.tid()
    s = row[i]
    if s < 0 or (clear_out[i] & ((1 << t) - 1)) != 0:
        return
    h = at.index[at.of[s]] // held.tries
    G = hand.kin.groups
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    for g in range(G):
        x = _opened_share(at.posture[s, g], opened[i, g, 0], t)
        group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
        if at.chosen[s, g] >= 0:
            r = at.of[s]
            if finger_clear(hand, obj, held, limits, h, g, at.pose[r], at.resting[r], X, off[i]) == 0:
                return
    for b in range(G):
        for a in range(b + 2):
            moves = at.chosen[s, b] >= 0 or (a > 0 and at.chosen[s, wp.max(a - 1, 0)] >= 0)
            if moves and not hand_pairs_clear(hand, a, b + 1, X, limits.min_self_distance):
                return
    wp.atomic_or(clear_out, i, 1 << t)


@wp.func
def _first_try(clear: wp.int32):
    """The lowest bit that is set; there is one."""
    t = int(0)
    while (clear >> t) & 1 == 0:
        t += 1
    return t


@wp.func
def _sinks(
    hand: Hand,
    obj: Object,
    held: Held,
    h: wp.int32,
    body: wp.int32,
    T_object: wp.transform,
    X: wp.transform,
    off: wp.float32,
):
    """True if points of the object are deeper in a body whose own are off it than they may, or the body is in what is
    held.

    Args:
        T_object: T_object_hand. X: pose of the body in the hand frame.
        off: how far the body must be off the object [m]; below 0 they may be that deep.
    """
    limit = wp.max(0.0, -off)
    T = T_object * X
    if not body_far(hand, obj, body, T, 0.0) and obstacles_depth(hand, obj, body, T, limit, 0, 1) > limit:
        return True
    return body_depth_in_held(hand, held, h, body, X, 0.0) > 0.0


@wp.kernel
def check_openings(
    hand: Hand,
    obj: Object,
    held: Held,
    at: CheckedPostures,
    opened: wp.array3d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    off: wp.array2d(dtype=wp.float32),
    clear_out: wp.array(dtype=wp.int32),
):
    """One thread per (body, row): is a body of a touching finger out of the objects by their points, too, as far open
    as the first try that is clear? No try is where one is not.

    Args:
        opened: (m, G, 2) of :func:`~lgrasp.grasp.control_kernels.control_poses`.
        row: (m,) hand of each row, -1 none.
        off: (m, bodies - 1) of :func:`find_distances_off` [m].
        clear_out: (m,) of :func:`try_openings`.
    """
    j, i = wp.tid()
    s = row[i]
    if s < 0:
        return
    g = hand.body_group[1 + j]
    clear = clear_out[i]
    if clear == 0 or g < 0 or at.chosen[s, wp.max(g, 0)] < 0:
        return
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    x = _opened_share(at.posture[s, g], opened[i, g, 0], _first_try(clear))
    group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
    h = at.index[at.of[s]] // held.tries
    T_object = wp.transform_inverse(at.pose[at.of[s]])
    if _sinks(hand, obj, held, h, 1 + j, T_object, X[j], off[i, j]):
        clear_out[i] = 0


@wp.func
def put_opening(i: wp.int32, least: wp.float32, most: wp.float32, packed_out: Packed):
    """How far touching fingers are opened at least, 0 without any, and any finger at most [rad or m]."""
    packed_out.closing_travel[i] = most
    packed_out.pregrasp_opening[i] = wp.where(least == _NOT_TOUCHING, 0.0, least)


@wp.kernel
def open_poses(
    hand: Hand,
    at: CheckedPostures,
    opened: wp.array3d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    clear: wp.array(dtype=wp.int32),
    packed_out: Packed,
    stuck_out: wp.array(dtype=wp.int32),
):
    """The touching fingers as far open as is clear (:func:`try_openings`); rows of which no try is are listed.

    Args:
        opened: (m, G, 2) of :func:`~lgrasp.grasp.control_kernels.control_poses`.
        row: (m,) hand of each row, -1 none.
        clear: (m,) bit t: try t is clear.
        stuck_out: (1 + m,) how many rows are listed, and these.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    if clear[i] == 0:
        stuck_out[1 + wp.atomic_add(stuck_out, 0, 1)] = i
        return
    t = _first_try(clear[i])
    least = float(_NOT_TOUCHING)
    most = float(0.0)
    for g in range(hand.kin.groups):
        x = _opened_share(at.posture[s, g], opened[i, g, 0], t)
        moved = put_pregrasp(hand, g, x, at.posture[s, g], i, packed_out)
        most = wp.max(most, moved)
        if at.chosen[s, g] >= 0:
            least = wp.min(least, moved)
    put_opening(i, least, most, packed_out)


@wp.func
def opened_finger(
    hand: Hand, held: Held, h: wp.int32, g: wp.int32, t: wp.int32, q: vec_dof, opened: vec_dof, freed: vec_dof
):
    """A finger on its way from q to ``opened``, from all of it down, so to ``freed``, then on its way to the open
    posture of the hand."""
    if t < OPENING_SHARES:
        return _opened_share(q, opened, t)
    if t < 2 * OPENING_SHARES:
        return _opened_share(q, freed, t - OPENING_SHARES)
    away = held.posture[h, g] - q
    for d in range(hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]):
        if d >= hand.kin.dof_free[g] or (held.frozen[h, g] >> d) & 1 == 1:
            away[d] = 0.0
    return q + (float(t + 1) / float(OPENING_SHARES) - 2.0) * away


@wp.func
def _to_try(hand: Hand, g: wp.int32, t: wp.int32, q: vec_dof, freed: vec_dof):
    """False for the way to ``freed`` of a finger with one contact."""
    return t < OPENING_SHARES or t >= 2 * OPENING_SHARES or joint_motion(hand, g, freed, q) > 0.0


@wp.kernel
def try_fingers(
    hand: Hand,
    obj: Object,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array3d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    off: wp.array2d(dtype=wp.float32),
    stuck: wp.array(dtype=wp.int32),
    clear_out: wp.array2d(dtype=wp.int32),
):
    """One thread per (row listed, group, try): is the finger off the object and what is held, by all points?

    Args:
        opened: (m, G, 2) of :func:`~lgrasp.grasp.control_kernels.control_poses`.
        row: (m,) hand of each row, -1 none.
        off: (m, bodies - 1) of :func:`find_distances_off` [m].
        stuck: (1 + m,) how many rows are listed, and these.
        clear_out: (m, G) bit t: try t is; of zeros.
    """
    k, g, t = wp.tid()
    if k >= stuck[0]:
        return
    i = stuck[1 + k]
    s = row[i]
    if at.chosen[s, g] < 0 or not _to_try(hand, g, t, at.posture[s, g], opened[i, g, 1]):
        return
    h = at.index[at.of[s]] // held.tries
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    x = opened_finger(hand, held, h, g, t, at.posture[s, g], opened[i, g, 0], opened[i, g, 1])
    group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
    r = at.of[s]
    if finger_clear(hand, obj, held, limits, h, g, at.pose[r], at.resting[r], X, off[i]) == 0:
        return
    for j in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
        if _sinks(hand, obj, held, h, 1 + j, wp.transform_inverse(at.pose[r]), X[j], off[i, j]):
            return
    wp.atomic_or(clear_out, k, g, 1 << t)


@wp.kernel
def open_fingers(
    hand: Hand,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array3d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    stuck: wp.array(dtype=wp.int32),
    clear: wp.array2d(dtype=wp.int32),
    packed_out: Packed,
):
    """Each finger of the rows listed opened by itself, in turn: the first try that is clear of the hand as well, or q.

    Args:
        opened: (m, G, 2) of :func:`~lgrasp.grasp.control_kernels.control_poses`.
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
    most = float(0.0)
    for g in range(G):
        x = at.posture[s, g]
        done = wp.where(at.chosen[s, g] >= 0, 0, 1)
        for t in range(FINGER_TRIES):
            if done == 0 and (clear[k, g] >> t) & 1 == 1:
                x = opened_finger(hand, held, h, g, t, at.posture[s, g], opened[i, g, 0], opened[i, g, 1])
                group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
                done = int(1)
                for b in range(G + 1):
                    if done == 1 and not hand_pairs_clear(hand, b, g + 1, X, limits.min_self_distance):
                        done = 0
        if done == 0:
            x = at.posture[s, g]
            group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
        moved = put_pregrasp(hand, g, x, at.posture[s, g], i, packed_out)
        most = wp.max(most, moved)
        if at.chosen[s, g] >= 0:
            least = wp.min(least, moved)
    put_opening(i, least, most, packed_out)

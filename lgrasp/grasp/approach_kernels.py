"""Kernels of grasps of objects on a table: the hand above it, and a straight way for the open hand to the grasp."""

import warp as wp

from lgrasp.grasp.check_kernels import ALL, TOUCHING
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed
from lgrasp.grasp.closing_kernels import closing_finger
from lgrasp.grasp.collision import body_depth, body_height, resting_plane
from lgrasp.grasp.outcomes import Outcome
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_dofs, group_forward
from lgrasp.math.limits import MAX_BODIES
from lgrasp.math.sdf import sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

APPROACH_LENGTH = 0.15
"""Way of the open hand to the grasp [m]."""
RETREATS = wp.constant(7)
"""Directions in which the hand is tried to leave, by this order."""

GPU_STRETCHES = 5
"""Parts of the way that a GPU looks at side by side."""

_COARSE_STEPS = wp.constant(15)  # of all ways
_STEPS = wp.constant(45)  # of the one that is taken, 3.3 mm each
_SURE = wp.constant(1.0e-3)  # [m] of a distance in a grid
_PARTS = wp.constant(8)  # of the way from q_pregrasp to q
_LEAST_SINE = wp.constant(1.0e-3)


@wp.struct
class Palm:
    """The palm in the base frame."""

    centre: wp.vec3  # [m]
    facing: wp.vec3  # unit vector


@wp.func
def _unit(v: wp.vec3, other: wp.vec3):
    """The unit vector along v, or another one where it has no length."""
    return wp.where(wp.length(v) > _LEAST_SINE, wp.normalize(v), other)


@wp.func
def retreat(palm: Palm, up: wp.vec3, com: wp.vec3, k: wp.int32):
    """Direction k in which a hand may leave an object: away from where the palm faces, up, away from the centre of mass
    ``com``, between these, level."""
    back = -palm.facing
    away = _unit(palm.centre - com, back)
    if k == 1:
        return _unit(back + up, up)
    if k == 2:
        return up
    if k == 3:
        return away
    if k == 4:
        return _unit(away + up, up)
    if k == 5:
        return _unit(back + away, back)
    if k == 6:
        return _unit(back - up * wp.dot(back, up), up)
    return back


@wp.kernel
def check_table(hand: Hand, obj: Object, limits: Limits, part: wp.int32, at: CheckedPostures, found_out: Findings):
    """One thread per (body, hand): hands fail if a body of a part (TOUCHING, OTHERS or ALL) is not above the table."""
    b, i = wp.tid()
    row = at.of[i]
    g = hand.body_group[b]
    touching = g < 0 or (part != ALL and at.chosen[i, wp.max(g, 0)] >= 0)
    if at.resting[row] < 0 or found_out.outcome[i] != Outcome.KEPT:
        return
    if part != ALL and touching != (part == TOUCHING):
        return
    B = wp.transform_identity()
    if b > 0:
        B = at.body[i, b - 1]
    plane = resting_plane(obj, at.pose[row], at.resting[row])
    if body_height(hand.pieces, b, B, plane, limits.min_table_distance) < limits.min_table_distance:
        found_out.outcome[i] = Outcome.TABLE


@wp.func
def _up(obj: Object, at: CheckedPostures, s: wp.int32):
    """Unit normal of the table below hand s, base frame."""
    return wp.transform_vector(at.pose[at.of[s]], obj.resting.up[at.resting[at.of[s]]])


@wp.func
def _way_off(palm: Palm, obj: Object, at: CheckedPostures, s: wp.int32, k: wp.int32):
    """:func:`retreat` k of hand s, base frame."""
    return retreat(palm, _up(obj, at, s), wp.transform_point(at.pose[at.of[s]], obj.com), k)


@wp.func
def first_clear(clear: wp.array(dtype=wp.int32), i: wp.int32):
    """The first retreat of row i that is clear, -1 none."""
    for k in range(RETREATS):
        if (clear[i] >> k) & 1 == 1:
            return k
    return -1


@wp.func
def _body_pose(hand: Hand, b: wp.int32, q: wp.array2d(dtype=wp.float32), row: wp.int32):
    """T_base_body of body b with row ``row`` of q (N, K)."""
    if b == 0:
        return wp.transform_identity()
    g = hand.body_group[b]
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    first = group_forward(hand.kin, g, group_dofs(hand.kin, g, q, row), X, 0)
    return X[b - 1 - first]


@wp.func
def _way_blocked(
    hand: Hand, obj: Object, limits: Limits, b: wp.int32, T: wp.transform, way: wp.vec3, first: wp.int32, end: wp.int32
):
    """True if a body comes too deep into the object at a step from ``first`` to before ``end`` of the way from
    T = T_object_body along ``way`` (object's frame)."""
    ball = hand.pieces.body_sphere[b]
    if ball[3] < 0.0:
        return False
    centre = wp.transform_point(T, wp.vec3(ball[0], ball[1], ball[2]))
    length = APPROACH_LENGTH / float(_STEPS)
    step = int(first)
    while step < end:
        by = way * (length * float(step + 1))
        clear = sdf_value(obj.sdf, centre + by) - ball[3] - _SURE
        if clear > 0.0:
            step += wp.max(1, int(clear / length))  # it cannot touch before
        else:
            moved = wp.transform(wp.transform_get_translation(T) + by, wp.transform_get_rotation(T))
            if body_depth(hand, obj, b, moved, limits.max_penetration) > limits.max_penetration:
                return True
            step += 1
    return False


@wp.kernel
def try_retreats(
    hand: Hand,
    obj: Object,
    limits: Limits,
    palm: Palm,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    packed: Packed,
    clear_out: wp.array(dtype=wp.int32),
):
    """One thread per (row kept, retreat): does the open hand leave that way, not downwards, and clear of the object?

    Retreats after one that is clear may be left out.

    Args:
        row: (m,) hand of each row, -1 none.
        clear_out: (m,) bit k: retreat k is; of zeros.
    """
    i, k = wp.tid()
    s = row[i]
    if s < 0 or clear_out[i] & ((1 << k) - 1) != 0:
        return
    T = at.pose[at.of[s]]
    way = _way_off(palm, obj, at, s, k)
    if wp.dot(way, _up(obj, at, s)) < 0.0:
        return
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    for g in range(hand.kin.groups):
        group_forward(hand.kin, g, group_dofs(hand.kin, g, packed.q_pregrasp, i), X, hand.kin.joint_first[g])
    T_object = wp.transform_inverse(T)
    bodies = hand.body_group.shape[0]
    for step in range(_COARSE_STEPS):
        moved = wp.transform(way * (APPROACH_LENGTH * float(step + 1) / float(_COARSE_STEPS)), wp.quat_identity())
        for b in range(bodies):
            B = moved
            if b > 0:
                B = moved * X[b - 1]
            if body_depth(hand, obj, b, T_object * B, limits.max_penetration) > limits.max_penetration:
                return
    wp.atomic_or(clear_out, i, 1 << k)


@wp.kernel
def check_way(
    hand: Hand,
    obj: Object,
    limits: Limits,
    palm: Palm,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    packed: Packed,
    clear: wp.array(dtype=wp.int32),
    stretches: wp.int32,
    refused_out: wp.array(dtype=wp.int32),
):
    """One thread per (stretch, body, row kept): is the first retreat that is clear so at every step of a stretch?

    Args:
        row: (m,) hand of each row, -1 none.
        clear: (m,) bit k: retreat k is clear.
        stretches: of the way.
        refused_out: (m,) 1: it is not; of zeros.
    """
    stretch, b, i = wp.tid()
    s = row[i]
    k = first_clear(clear, i)
    if s < 0 or k < 0 or refused_out[i] == 1:
        return
    T = at.pose[at.of[s]]
    way = _way_off(palm, obj, at, s, k)
    T_object = wp.transform_inverse(T)
    B = T_object * _body_pose(hand, b, packed.q_pregrasp, i)
    first, end = stretch * _STEPS // stretches, (stretch + 1) * _STEPS // stretches
    if _way_blocked(hand, obj, limits, b, B, wp.transform_vector(T_object, way), first, end):
        refused_out[i] = 1


@wp.kernel
def close_above(
    hand: Hand,
    obj: Object,
    limits: Limits,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    packed: Packed,
    refused_out: wp.array(dtype=wp.int32),
):
    """One thread per (group, row kept): does the finger stay above the table on its way from ``q_pregrasp`` to ``q``?

    Args:
        row: (m,) hand of each row, -1 none.
        refused_out: (m,) 1: a finger does not.
    """
    g, i = wp.tid()
    s = row[i]
    if s < 0:
        return
    q = at.posture[s, g]
    x = group_dofs(hand.kin, g, packed.q_pregrasp, i)
    plane = resting_plane(obj, at.pose[at.of[s]], at.resting[at.of[s]])
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    for part in range(1, _PARTS):
        between = closing_finger(x, q, float(part) / float(_PARTS))
        group_forward(hand.kin, g, between, X, hand.kin.joint_first[g])
        for j in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
            if body_height(hand.pieces, 1 + j, X[j], plane, limits.min_table_distance) < limits.min_table_distance:
                refused_out[i] = 1
                return


@wp.kernel
def choose_approach(
    obj: Object,
    palm: Palm,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    clear: wp.array(dtype=wp.int32),
    refused: wp.array(dtype=wp.int32),
    packed_out: Packed,
    counts_out: wp.array(dtype=wp.int32),
):
    """The resting pose and the way to each row: the first retreat that is clear, reversed; NaN where none is.

    Args:
        row: (m,) hand of each row, -1 none.
        clear: (m,) bit k: retreat k is clear.
        refused: (m,) 1: the way is not clear after all, or a finger that closes is not above the table.
        counts_out: (reasons,) rows without a way are moved from those that are kept.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    packed_out.resting[i] = at.resting[at.of[s]]
    packed_out.approach[i] = wp.vec3(wp.nan, wp.nan, wp.nan)
    k = first_clear(clear, i)
    if k >= 0 and refused[i] == 0:
        packed_out.approach[i] = -_way_off(palm, obj, at, s, k)
        return
    wp.atomic_sub(counts_out, Outcome.KEPT, 1)
    wp.atomic_add(counts_out, Outcome.APPROACH, 1)

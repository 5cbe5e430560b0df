"""Kernels of grasps of objects on a table: the hand above it, and a straight way for the open hand to the grasp."""

import warp as wp

from lgrasp.grasp.check_kernels import ALL, TOUCHING
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed
from lgrasp.grasp.collision import body_depth, body_height, resting_plane
from lgrasp.grasp.outcomes import Outcome
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_dofs, group_forward
from lgrasp.math.limits import MAX_BODIES
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

APPROACH_LENGTH = 0.15
"""Way of the open hand to the grasp [m]."""
RETREATS = wp.constant(7)
"""Directions in which the hand is tried to leave."""

_STEPS = wp.constant(15)
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
    up = wp.transform_vector(T, obj.resting.up[at.resting[at.of[s]]])
    way = retreat(palm, up, wp.transform_point(T, obj.com), k)
    if wp.dot(way, up) < 0.0:
        return
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    for g in range(hand.kin.groups):
        group_forward(hand.kin, g, group_dofs(hand.kin, g, packed.q_pregrasp, i), X, hand.kin.joint_first[g])
    T_object = wp.transform_inverse(T)
    bodies = hand.body_group.shape[0]
    for step in range(_STEPS):
        moved = wp.transform(way * (APPROACH_LENGTH * float(step + 1) / float(_STEPS)), wp.quat_identity())
        for b in range(bodies):
            B = moved
            if b > 0:
                B = moved * X[b - 1]
            if body_depth(hand, obj, b, T_object * B, limits.max_penetration) > limits.max_penetration:
                return
    wp.atomic_or(clear_out, i, 1 << k)


@wp.kernel
def close_above(
    hand: Hand,
    obj: Object,
    limits: Limits,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    packed: Packed,
    under_out: wp.array(dtype=wp.int32),
):
    """One thread per (group, row kept): does the finger stay above the table on its way from ``q_pregrasp`` to ``q``?

    Args:
        row: (m,) hand of each row, -1 none.
        under_out: (m,) 1: a finger does not; of zeros.
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
        group_forward(hand.kin, g, x + (float(part) / float(_PARTS)) * (q - x), X, hand.kin.joint_first[g])
        for j in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
            if body_height(hand.pieces, 1 + j, X[j], plane, limits.min_table_distance) < limits.min_table_distance:
                under_out[i] = 1
                return


@wp.kernel
def choose_approach(
    obj: Object,
    palm: Palm,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    clear: wp.array(dtype=wp.int32),
    under: wp.array(dtype=wp.int32),
    packed_out: Packed,
    counts_out: wp.array(dtype=wp.int32),
):
    """The resting pose and the way to each row: the first retreat that is clear, reversed; NaN where none is.

    Args:
        row: (m,) hand of each row, -1 none.
        clear: (m,) bit k: retreat k is clear.
        under: (m,) 1: a finger that closes is not above the table.
        counts_out: (reasons,) rows without a way are moved from those that are kept.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    T = at.pose[at.of[s]]
    pose = at.resting[at.of[s]]
    up = wp.transform_vector(T, obj.resting.up[pose])
    packed_out.resting[i] = pose
    packed_out.approach[i] = wp.vec3(wp.nan, wp.nan, wp.nan)
    for k in range(RETREATS):
        if (clear[i] >> k) & 1 == 1 and under[i] == 0:
            packed_out.approach[i] = -retreat(palm, up, wp.transform_point(T, obj.com), k)
            return
    wp.atomic_sub(counts_out, Outcome.KEPT, 1)
    wp.atomic_add(counts_out, Outcome.APPROACH, 1)

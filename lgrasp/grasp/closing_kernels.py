"""Kernels of the straight way that fingers close, from ``q_pregrasp`` to ``q``: into each other, through the object."""

import warp as wp

from lgrasp.grasp.bounds import ANY_PENETRATION
from lgrasp.grasp.check_kernels import hand_pairs_clear
from lgrasp.grasp.check_structs import CheckedPostures, Packed
from lgrasp.grasp.collision import body_apart, body_depth
from lgrasp.grasp.pregrasp_kernels import joint_motion, put_opening, put_pregrasp
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_dofs, group_forward, vec_dof
from lgrasp.math.limits import MAX_BODIES
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

CLOSING_PLACES = wp.constant(8)
"""Most places, in equal parts of the way, where fingers must be out of each other."""
_STEP = wp.constant(0.15)  # [rad or m] of the joint that moves most: there is a place for each
_PARTS = wp.constant(3)  # of the way on which penetration is measured
_DEEPEST = wp.constant(ANY_PENETRATION)  # [m]
_INSIDE = wp.constant(0.15e-3)  # [m] what is deeper does not just touch
_NEAR = wp.constant(0.002)  # [m] bodies whose samples are farther from the object do not penetrate


@wp.func
def closing_finger(x: vec_dof, q: vec_dof, share: wp.float32):
    """A finger on its straight way from x, as in ``q_pregrasp`` (share 0), to q (1)."""
    return x + share * (q - x)


@wp.kernel
def find_crossings(
    hand: Hand,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    packed: Packed,
    crossed_out: wp.array(dtype=wp.int32),
):
    """One thread per (place, row): do fingers that close go through each other, or the base, there?

    Args:
        row: (m,) hand of each row, -1 none.
        crossed_out: (m,) 1: they do; of zeros.
    """
    place, i = wp.tid()
    s = row[i]
    if s < 0 or crossed_out[i] == 1:
        return
    places = wp.clamp(int(packed.closing_travel[i] / _STEP), 1, int(CLOSING_PLACES))
    if place >= places:
        return
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    share = float(1 + place) / float(1 + places)
    moves = int(0)
    for g in range(hand.kin.groups):
        x = closing_finger(group_dofs(hand.kin, g, packed.q_pregrasp, i), at.posture[s, g], share)
        group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
        if joint_motion(hand, g, x, at.posture[s, g]) > 0.0:
            moves = moves | (1 << (1 + g))
    for b in range(1, hand.kin.groups + 1):
        for a in range(b):
            if ((moves >> a) | (moves >> b)) & 1 == 1 and not hand_pairs_clear(hand, a, b, X, 0.0):
                crossed_out[i] = 1
                return


@wp.kernel
def keep_closed(
    hand: Hand,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    crossed: wp.array(dtype=wp.int32),
    packed_out: Packed,
):
    """Hands whose fingers would cross as they close are not opened, one thread per row.

    Args:
        row: (m,) hand of each row, -1 none.
        crossed: (m,) of :func:`find_crossings`.
    """
    i = wp.tid()
    s = row[i]
    if s >= 0 and crossed[i] == 1:
        for g in range(hand.kin.groups):
            put_pregrasp(hand, g, at.posture[s, g], at.posture[s, g], i, packed_out)
        put_opening(i, 0.0, 0.0, packed_out)


@wp.kernel
def measure_closing(
    hand: Hand,
    obj: Object,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    off: wp.array2d(dtype=wp.float32),
    packed_out: Packed,
):
    """Deepest penetration [m] of fingers and object two thirds of the straight way from ``q_pregrasp`` to ``q``, and
    how far the middle of a link moves in thirds of that way which it begins inside the object [m], the first left out:
    a finger that goes through the object pushes it away, however thin that is. Not of bodies on which it just rests.

    One thread per (group, row); ``closing_penetration`` and ``closing_sweep`` grow to the largest.

    Args:
        row: (m,) hand of each row, -1 none.
        off: (m, bodies - 1) of :func:`~lgrasp.grasp.pregrasp_kernels.find_distances_off` [m].
    """
    g, i = wp.tid()
    s = row[i]
    if s < 0:
        return
    q = at.posture[s, g]
    x = group_dofs(hand.kin, g, packed_out.q_pregrasp, i)
    if joint_motion(hand, g, x, q) == 0.0:
        return
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    before = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    inside = wp.zeros(shape=(MAX_BODIES,), dtype=wp.int32)
    swept = wp.zeros(shape=(MAX_BODIES,), dtype=wp.float32)
    T_object = wp.transform_inverse(at.pose[at.of[s]])
    deepest = float(0.0)
    farthest = float(0.0)
    for part in range(1, _PARTS + 1):
        between = closing_finger(x, q, float(part) / float(_PARTS))
        group_forward(hand.kin, g, between, X, hand.kin.joint_first[g])
        for j in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
            ball = hand.pieces.body_sphere[1 + j]
            middle = wp.vec3(ball[0], ball[1], ball[2])
            if inside[j] == 1:
                swept[j] += wp.length(wp.transform_point(X[j], middle) - wp.transform_point(before[j], middle))
                farthest = wp.max(farthest, swept[j])
            before[j] = X[j]
            inside[j] = 0
            T = T_object * X[j]
            if part < _PARTS and not body_apart(hand, obj, 1 + j, T, wp.where(off[i, j] < 0.0, off[i, j], _NEAR)):
                last = part == _PARTS - 1
                depth = body_depth(hand, obj, 1 + j, T, wp.where(last, _DEEPEST, _INSIDE))
                if last:
                    deepest = wp.max(deepest, depth)
                if depth > _INSIDE:
                    inside[j] = 1
    if deepest > 0.0:
        wp.atomic_max(packed_out.closing_penetration, i, deepest)
    if farthest > 0.0:
        wp.atomic_max(packed_out.closing_sweep, i, farthest)

"""Tests that parts of a hand are apart: bounding balls, then true convex distance; sockets on true surfaces."""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.math.convex import pieces_clear
from lgrasp.math.sdf import sdf_of, sdf_value
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

OVERLAP = 8.5e-4
"""Depth [m] to which such pairs may overlap; a grasp is strictly valid to 1 mm."""


@wp.func
def _side_depth(hand: Hand, k: wp.int32, T: wp.transform, limit: wp.float32):
    """Deepest point [m] of side k in its grid, 0 when apart; stops early above ``limit``. T = T_grid_points."""
    grid = sdf_of(hand.overlaps.grids, k)
    side = hand.overlaps.sides[k]
    depth = float(0.0)
    for i in range(side[2], side[3]):
        depth = wp.max(depth, -sdf_value(grid, wp.transform_point(T, hand.overlaps.points[i])))
        if depth > limit:
            break
    return depth


@wp.func
def group_pairs_clear(
    hand: Hand,
    a: wp.int32,
    b: wp.int32,
    Xa: wp.array(dtype=wp.transform),
    at_a: wp.int32,
    Xb: wp.array(dtype=wp.transform),
    at_b: wp.int32,
    margin: wp.float32,
):
    """Are the listed piece pairs of groups a and b (a <= b; 0 = static base, g + 1 = group g) all beyond the margin,
    and does no pair that is tested on its true surfaces overlap by more than OVERLAP?

    Xa, Xb: local arrays with the two groups' body poses from places at_a, at_b on (Xa is not read for the base).
    """
    key = a * (hand.kin.groups + 1) + b
    ja = int(0)
    if a > 0:
        ja = hand.kin.joint_first[a - 1] + 1 - at_a
    jb = int(0)
    if b > 0:
        jb = hand.kin.joint_first[b - 1] + 1 - at_b
    for k in range(hand.pair_first[key], hand.pair_first[key + 1]):
        i = hand.pairs[k][0]
        j = hand.pairs[k][1]
        Ti = wp.transform_identity()
        if a > 0:
            Ti = Xa[hand.pieces.body[i] - ja]
        Tj = wp.transform_identity()
        if b > 0:
            Tj = Xb[hand.pieces.body[j] - jb]
        si = hand.pieces.sphere[i]
        sj = hand.pieces.sphere[j]
        ci = wp.transform_point(Ti, wp.vec3(si[0], si[1], si[2]))
        cj = wp.transform_point(Tj, wp.vec3(sj[0], sj[1], sj[2]))
        reach = si[3] + sj[3] + margin
        d = ci - cj
        if wp.dot(d, d) >= reach * reach:
            continue
        if not pieces_clear(hand.pieces, i, j, wp.transform_inverse(Ti) * Tj, margin):
            return False
    for k in range(hand.overlaps.first[key], hand.overlaps.first[key + 1]):
        side = hand.overlaps.sides[k]
        Tp = wp.transform_identity()
        Tg = wp.transform_identity()
        # which of the two groups a body is in; for a = b either is right
        if hand.body_group[side[0]] + 1 == b:
            Tp = Xb[side[0] - jb]
        elif a > 0:
            Tp = Xa[side[0] - ja]
        if hand.body_group[side[1]] + 1 == b:
            Tg = Xb[side[1] - jb]
        elif a > 0:
            Tg = Xa[side[1] - ja]
        if _side_depth(hand, k, wp.transform_inverse(Tg) * Tp, OVERLAP) > OVERLAP:
            return False
    return True


@wp.func
def overlap_depth(hand: Hand, X: wp.array2d(dtype=wp.transform), row: wp.int32):
    """Deepest overlap [m] of the pairs that are tested on their true surfaces, 0 when apart; X (N, bodies - 1)."""
    depth = float(0.0)
    for k in range(hand.overlaps.sides.shape[0]):
        side = hand.overlaps.sides[k]
        Tp = wp.transform_identity()
        Tg = wp.transform_identity()
        if side[0] > 0:
            Tp = X[row, side[0] - 1]
        if side[1] > 0:
            Tg = X[row, side[1] - 1]
        depth = wp.max(depth, _side_depth(hand, k, wp.transform_inverse(Tg) * Tp, 1.0))
    return depth

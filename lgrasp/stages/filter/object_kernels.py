"""Kernels that measure the penetration of hand and objects."""

import warp as wp

from lgrasp.grasp.collision import body_depth, objects_apart
from lgrasp.grasp.held import Held, body_depth_in_held, group_fixed
from lgrasp.hand.arrays import Hand
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def deepen(
    hand: Hand,
    obj: Object,
    max_depth: wp.float32,
    used: wp.int32,
    pose: wp.array(dtype=wp.transform),
    set_pose: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    body: wp.array2d(dtype=wp.transform),
    outcome: wp.array(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.float32),
):
    """Largest penetration [m] of the base and the touching fingers (used = 1) or of the others (used = 0).

    One thread per (body, set), so that neighbours do like work; ``depth_out`` grows to the largest. Above ``max_depth``
    its value is of no account.
    """
    b, i = wp.tid()
    if outcome[i] != 0 or depth_out[i] > max_depth:
        return
    g = hand.body_group[b]
    B = wp.transform_identity()
    if g < 0:
        if used == 0:
            return
    else:
        if (chosen[i, g] >= 0) != (used == 1):
            return
        B = body[i, b - 1]
    T = wp.transform_inverse(pose[set_pose[i]]) * B
    d = body_depth(hand, obj, b, T, max_depth)
    if d > 0.0:
        wp.atomic_max(depth_out, i, d)


@wp.kernel
def deepen_held(
    hand: Hand,
    obj: Object,
    held: Held,
    max_depth: wp.float32,
    margin: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    set_pose: wp.array(dtype=wp.int32),
    body: wp.array2d(dtype=wp.transform),
    outcome: wp.array(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.float32),
):
    """Largest penetration [m] of what may move and the held objects; the new object must keep ``margin`` [m] from them.

    One thread per (body, set), the base's is that of the new object; ``depth_out`` grows to the largest.
    """
    b, i = wp.tid()
    if outcome[i] != 0 or depth_out[i] > max_depth:
        return
    row = set_pose[i]
    h = index[row] // held.tries
    if b == 0:
        for k in range(held.objects):
            if not objects_apart(obj, held.object[k], wp.transform_inverse(held.pose[h, k]) * pose[row], margin):
                wp.atomic_max(depth_out, i, 1.0)
                return
        return
    if not group_fixed(hand, held, h, hand.body_group[b]):
        d = body_depth_in_held(hand, held, h, b, body[i, b - 1], max_depth)
        if d > 0.0:
            wp.atomic_max(depth_out, i, d)

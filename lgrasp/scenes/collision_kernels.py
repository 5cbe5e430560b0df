"""Kernels of grasps in a scene: how deep a hand sinks into the table or into objects."""

import warp as wp

from lgrasp.grasp.collision import body_depth, body_height
from lgrasp.hand.arrays import Hand
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def hand_depths(
    hand: Hand,
    objects: wp.array(dtype=Object),
    own: wp.int32,
    T_object_scene: wp.array(dtype=wp.transform),
    T_scene_hand: wp.array(dtype=wp.transform),
    body: wp.array2d(dtype=wp.transform),
    limit: wp.float32,
    # out
    table_out: wp.array(dtype=wp.float32),
    object_out: wp.array(dtype=wp.float32),
):
    """One thread per (hand, body): how deep a hand sinks into z < 0 and into all objects but ``own`` [m].

    Depths above ``limit`` may be given too small, but not below it.

    Args:
        objects: (M,).
        T_object_scene: of each object, (M,).
        T_scene_hand: of each hand, (N,).
        body: T_hand_body, (N, B).
        table_out: [m], (N,), zero before.
        object_out: [m], (N,), zero before.
    """
    i, b = wp.tid()
    T = T_scene_hand[i] * body[i, b]
    table = -body_height(hand.pieces, b, T, wp.vec4(0.0, 0.0, 1.0, 0.0), 0.0)
    if table > 0.0:
        wp.atomic_max(table_out, i, table)
    depth = float(0.0)
    for k in range(objects.shape[0]):
        if k != own and depth <= limit:
            depth = wp.max(depth, body_depth(hand, objects[k], b, T_object_scene[k] * T, limit))
    if depth > 0.0:
        wp.atomic_max(object_out, i, depth)

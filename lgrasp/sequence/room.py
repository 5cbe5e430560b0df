"""How much room a grasp leaves to the fingers that hold nothing yet."""

import numpy as np
import warp as wp

from lgrasp.grasp.collision import body_clear
from lgrasp.grasp.held import Held
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_forward
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.fetch import to_numpy
from lgrasp.stages.context import Context

wp.set_module_options(KERNEL_OPTIONS)

POSTURES = wp.constant(16)
"""Of each finger, the same for all grasps."""

_ALLOWED_PENETRATION = wp.constant(0.0005)  # [m]


@wp.kernel
def count_clear(
    hand: Hand,
    obj: Object,
    held: Held,
    row: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    counts: wp.array2d(dtype=wp.int32),
    # out
    clear_out: wp.array(dtype=wp.int32),
):
    """One thread per (grasp, group): postures of a group that counts in which it is clear of all objects.

    Args:
        row: of ``held`` that each grasp continues, (M,).
        pose: T_hand_object, (M,).
        counts: 1 for groups that count, by row of ``held``, (H, G).
        clear_out: postures, (M,), zero before.
    """
    i, g = wp.tid()
    if counts[row[i], g] == 0:
        return
    h = row[i]
    state = wp.rand_init(17, g)
    T_object = wp.transform_inverse(pose[i])
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    first = hand.kin.dof_first[g]
    for _p in range(POSTURES):
        x = held.posture[h, g]
        for d in range(hand.kin.dof_free[g]):
            low = hand.kin.dof_lower[first + d]
            x[d] = low + wp.randf(state) * (hand.kin.dof_upper[first + d] - low)
        j0 = group_forward(hand.kin, g, x, X, 0)
        clear = int(1)
        for j in range(hand.kin.joint_first[g + 1] - j0):
            if clear == 1 and not body_clear(hand, obj, 1 + j0 + j, T_object * X[j], _ALLOWED_PENETRATION):
                clear = 0
            for k in range(held.objects):
                T_held = wp.transform_inverse(held.pose[h, k]) * X[j]
                if clear == 1 and not body_clear(hand, held.object[k], 1 + j0 + j, T_held, _ALLOWED_PENETRATION):
                    clear = 0
        wp.atomic_add(clear_out, i, clear)


def room_left(free: np.ndarray, grasps: GraspTable, row: np.ndarray, context: Context) -> np.ndarray:
    """Share of random postures of the fingers that stay free in which these are clear of all objects, (M,) f32.

    Args:
        free: joints that hold nothing even after the grasp, (H, K) bool.
        grasps: M grasps of the context's object.
        row: row of the context's :class:`Held` that each continues, (M,).
    """
    tree, d = context.hand.model.tree, context.device
    counts = np.zeros((len(free), tree.groups), np.int32)
    for g in range(tree.groups):
        own = tree.own_dofs(g)
        counts[:, g] = free[:, own].all(1) if len(own) else 0
    clear = wp.zeros(len(row), dtype=wp.int32, device=d)
    wp.launch(
        count_clear,
        dim=(len(row), tree.groups),
        inputs=[
            context.hand.struct,
            context.object.struct,
            context.held.struct,
            wp.array(row.astype(np.int32), dtype=wp.int32, device=d),
            wp.array(grasps.pose, dtype=wp.transform, device=d),
            wp.array(counts, dtype=wp.int32, device=d),
        ],
        outputs=[clear],
        device=d,
    )
    return (to_numpy(clear) / np.maximum(counts[row].sum(1) * int(POSTURES), 1)).astype(np.float32)

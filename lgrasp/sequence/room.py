"""How much room a grasp leaves to the fingers that hold nothing yet."""

import numpy as np
import warp as wp

from lgrasp.grasp.tables import GraspTable
from lgrasp.sequence.kernels import POSTURES, count_clear
from lgrasp.stages.context import Context


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
        own = tree.dof_index[tree.dof_first[g] : tree.dof_first[g] + tree.dof_free[g]]
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
    return (clear.numpy() / np.maximum(counts[row].sum(1) * int(POSTURES), 1)).astype(np.float32)

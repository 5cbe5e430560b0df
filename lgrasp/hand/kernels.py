"""Poses of bodies at postures."""

import warp as wp

from lgrasp.math.kinematics import MAX_JOINTS, Kinematics, group_dofs, group_forward
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def place_bodies(
    h: Kinematics,
    q: wp.array2d(dtype=wp.float32),
    # out
    pose_out: wp.array2d(dtype=wp.transform),
):
    """Bodies of postures in the base frame; launched over postures.

    Args:
        q: [rad or m], (N, K).
        pose_out: T_base_body, (N, B).
    """
    row = wp.tid()
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    pose_out[row, 0] = wp.transform_identity()
    for g in range(h.groups):
        first = group_forward(h, g, group_dofs(h, g, q, row), X, 0)
        for j in range(h.joint_first[g + 1] - first):
            pose_out[row, 1 + first + j] = X[j]

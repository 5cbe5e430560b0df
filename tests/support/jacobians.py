"""Derivatives of points on a hand by its joints, from the columns that kernels add up."""

import numpy as np
import warp as wp

from lgrasp.hand.arrays import HandArrays, body_poses
from lgrasp.math.kinematics import Kinematics, point_column
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def move_points(
    h: Kinematics,
    pose: wp.array2d(dtype=wp.transform),
    body_group: wp.array(dtype=wp.int32),
    body: wp.array(dtype=wp.int32),
    point: wp.array(dtype=wp.vec3),
    # out
    jacobian_out: wp.array3d(dtype=wp.float32),
):
    """Derivatives of the base positions of points by the joints, added up; launched over points.

    Args:
        pose: T_base_body, (N, B).
        body_group: group of each body, (B,).
        body: of each point, (N,).
        point: body's frame [m], (N,).
        jacobian_out: [m/rad or m/m], (N, 3, K), zero before.
    """
    row = wp.tid()
    b = body[row]
    g = body_group[b]
    if g < 0:
        return
    p = wp.transform_point(pose[row, b], point[row])
    first = h.joint_first[g]
    j = b - 1 - first
    while j >= 0:
        k = first + j
        v = point_column(h, k, pose[row, 1 + k], p)
        column = h.dof_index[h.dof_first[g] + h.joint_dof[k]]
        for a in range(3):
            jacobian_out[row, a, column] = jacobian_out[row, a, column] + v[a]
        j = h.joint_parent[k]


def point_jacobians(hand: HandArrays, q: np.ndarray, body: np.ndarray, point: np.ndarray) -> np.ndarray:
    """d(base position)/dq, (N, 3, K) [m/rad or m/m], of a body-frame point (N, 3) on body (N,) at postures q (N, K)."""
    poses = wp.array(body_poses(hand, q), dtype=wp.transform, device=hand.device)
    out = wp.zeros((len(q), 3, hand.model.dofs), dtype=wp.float32, device=hand.device)
    inputs = [
        hand.struct.kin,
        poses,
        wp.array(hand.model.tree.body_group, dtype=wp.int32, device=hand.device),
        wp.array(np.asarray(body, np.int32), dtype=wp.int32, device=hand.device),
        wp.array(np.ascontiguousarray(point, np.float32), dtype=wp.vec3, device=hand.device),
    ]
    wp.launch(move_points, dim=len(q), inputs=inputs, outputs=[out], device=hand.device)
    return out.numpy()

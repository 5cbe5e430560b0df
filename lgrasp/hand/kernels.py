"""Where bodies are at postures, and how their points move."""

import warp as wp

from lgrasp.math.kinematics import MAX_JOINTS, Kinematics, group_dofs, group_forward, point_column
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

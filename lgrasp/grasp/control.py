"""Motions of a finger by one of its contacts: off the object, and joint targets that press."""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.math.constants import SLIDING_ARM
from lgrasp.math.kinematics import MAX_DOFS, MAX_JOINTS, clamp_dofs, group_forward, point_column, vec_dof
from lgrasp.math.transforms import transforms
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_ARM = wp.constant(SLIDING_ARM)


@wp.func
def shift_contact(hand: Hand, g: wp.int32, q0: vec_dof, j: wp.int32, point: wp.vec3, by: wp.vec3):
    """Joint positions that move a point of the group's body j by ``by`` [m] (three damped steps), limits kept."""
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_free[g]
    q = q0
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    target = wp.vec3(0.0)
    for it in range(3):
        group_forward(hand.kin, g, q, X, 0)
        p = wp.transform_point(X[j], point)
        if it == 0:
            target = p + by
        e = target - p
        J = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
        a = j
        while a >= 0:
            d = hand.kin.joint_dof[j0 + a]
            J[d] = J[d] + point_column(hand.kin, j0 + a, X[a], p)
            a = hand.kin.joint_parent[j0 + a]
        # damped right inverse: dq = J^T (J J^T + c I)^-1 e
        A = wp.identity(n=3, dtype=wp.float32) * 1.0e-4
        for d in range(dofs):
            A = A + wp.outer(J[d], J[d])
        y = wp.inverse(A) * e
        for d in range(dofs):
            q[d] = q[d] + wp.clamp(wp.dot(J[d], y), -0.4, 0.4)
        q = clamp_dofs(hand.kin, g, q)
    return q


@wp.func
def press_contact(
    hand: Hand, g: wp.int32, q0: vec_dof, j: wp.int32, body: transforms, p: wp.vec3, f: wp.vec3, k: wp.float32
):
    """q + J^T f / stiffness: targets at which position control presses with force f [N] on point p of body j."""
    j0 = hand.kin.joint_first[g]
    q = q0
    a = j
    while a >= 0:
        stiffness = k
        if hand.kin.joint_prismatic[j0 + a] == 1:
            stiffness = k / (_ARM * _ARM)
        d = hand.kin.joint_dof[j0 + a]
        if d < hand.kin.dof_free[g]:
            q[d] = q[d] + wp.dot(point_column(hand.kin, j0 + a, body[j0 + a], p), f) / stiffness
        a = hand.kin.joint_parent[j0 + a]
    return clamp_dofs(hand.kin, g, q)

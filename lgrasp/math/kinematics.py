"""Forward kinematics of one dependency group in registers, and Jacobian columns of a point on it."""

import warp as wp

from lgrasp.math.limits import MAX_DOFS
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

vec_dof = wp.types.vector(MAX_DOFS, wp.float32)


@wp.struct
class Kinematics:
    """J joints with D dofs in group order, parents before children; joint j moves body j.

    ``joint_parent`` is an index inside the group, -1 for the static base. A joint's coordinate is
    ``mult * q[dof] + offset`` with ``dof`` an index inside the group, so mimic joints need no special case.

    A hand with W contact surfaces has its settings once for each: setting ``s`` is with surface ``s // settings``.
    """

    groups: wp.int32
    joint_first: wp.array(dtype=wp.int32)  # (groups + 1,)
    dof_first: wp.array(dtype=wp.int32)  # (groups + 1,)
    joint_parent: wp.array(dtype=wp.int32)  # (J,)
    joint_dof: wp.array(dtype=wp.int32)  # (J,)
    joint_mult: wp.array(dtype=wp.float32)  # (J,)
    joint_offset: wp.array(dtype=wp.float32)  # (J,) [rad or m]
    joint_axis: wp.array(dtype=wp.vec3)  # (J,) unit, in the joint's frame
    joint_prismatic: wp.array(dtype=wp.int32)  # (J,) 1: slides
    drive_prismatic: wp.array(dtype=wp.int32)  # (J,) 1: its drive slides
    joint_origin: wp.array(dtype=wp.transform)  # (J,) T_parent_joint at coordinate 0 [m]
    dof_lower: wp.array(dtype=wp.float32)  # (D,) [rad or m]
    dof_upper: wp.array(dtype=wp.float32)  # (D,) [rad or m]
    dof_index: wp.array(dtype=wp.int32)  # (D,) column of q that a group's dof is
    column_lower: wp.array(dtype=wp.float32)  # (K,) limits of the columns of q [rad or m]
    column_upper: wp.array(dtype=wp.float32)  # (K,)
    column_effort: wp.array(dtype=wp.float32)  # (K,) effort limits [N m or N], infinite: none
    column_sliding: wp.array(dtype=wp.int32)  # (K,) 1: the joint slides
    dof_free: wp.array(dtype=wp.int32)  # (groups,) dofs that the group moves itself; shared ones come after
    dof_shared: wp.array(dtype=wp.int32)  # (D,) which of the shared joints a dof is, -1 for a group's own
    shared: wp.int32  # joints that groups share
    settings: wp.int32  # V combinations of values of the shared joints
    dof_setting: wp.array2d(dtype=wp.float32)  # (W V, D) open posture with the shared joints in place


@wp.func
def group_forward(h: Kinematics, g: wp.int32, q: vec_dof, X: wp.array(dtype=wp.transform), at: wp.int32):
    """Write T_base_body of the group's bodies to the local array X from place ``at`` on; returns the first joint."""
    first = h.joint_first[g]
    for j in range(h.joint_first[g + 1] - first):
        k = first + j
        x = h.joint_mult[k] * q[h.joint_dof[k]] + h.joint_offset[k]
        o = h.joint_origin[k]
        p = wp.transform_get_translation(o)
        r = wp.transform_get_rotation(o)
        if h.joint_prismatic[k] == 1:
            p = p + wp.quat_rotate(r, h.joint_axis[k] * x)
        else:
            r = r * wp.quat_from_axis_angle(h.joint_axis[k], x)
        T = wp.transform(p, r)
        parent = h.joint_parent[k]
        if parent >= 0:
            T = X[at + parent] * T
        X[at + j] = T
    return first


@wp.func
def point_column(h: Kinematics, k: wp.int32, T: wp.transform, p: wp.vec3):
    """Velocity of point p (base frame) per unit rate of the dof behind joint k (body frame T) [m/rad or m/m]."""
    a = wp.transform_vector(T, h.joint_axis[k])
    v = a
    if h.joint_prismatic[k] == 0:
        v = wp.cross(a, p - wp.transform_get_translation(T))
    return v * h.joint_mult[k]


@wp.func
def clamp_dofs(h: Kinematics, g: wp.int32, q: vec_dof):
    """q of the group, clamped into the joint limits."""
    first = h.dof_first[g]
    r = q
    for d in range(h.dof_first[g + 1] - first):
        r[d] = wp.clamp(q[d], h.dof_lower[first + d], h.dof_upper[first + d])
    return r


@wp.func
def group_dofs(h: Kinematics, g: wp.int32, q: wp.array2d(dtype=wp.float32), row: wp.int32):
    """The group's part of row ``row`` of q (N, K)."""
    v = vec_dof()
    first = h.dof_first[g]
    for d in range(h.dof_first[g + 1] - first):
        v[d] = q[row, h.dof_index[first + d]]
    return v

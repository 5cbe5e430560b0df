"""Kernels of the domain stage: one per index of the contact field."""

import warp as wp

from lgrasp.device.kinematics import vec_dof
from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.field.arrays import Boxes, Field, boxes_pick, field_has, field_pick, field_seed
from lgrasp.hand.arrays import Hand
from lgrasp.object.arrays import Object

__all__ = ["draw_domains", "draw_domains_bvh"]

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def draw_domains(
    hand: Hand,
    field: Field,
    obj: Object,
    seed: wp.int32,
    attempts: wp.int32,
    keep: wp.int32,
    cosine: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    count_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array3d(dtype=wp.int32),
    record_out: wp.array3d(dtype=wp.int32),
    q_out: wp.array3d(dtype=vec_dof),
):
    """Contact domain of each (pose, group): surface points that a contact vector of the group meets."""
    row, g = wp.tid()
    state = wp.rand_init(seed, index[row] * hand.kin.groups + g)
    T = pose[row]
    R = wp.transform_get_rotation(T)
    t = wp.transform_get_translation(T)
    n = int(0)
    for _a in range(attempts):
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        p = wp.quat_rotate(R, obj.contact_points[i]) + t
        normal = -wp.quat_rotate(R, obj.contact_normals[i])
        row_in_field = field_has(field, g, p, normal)
        if row_in_field >= 0:
            pick = field_pick(field, g, row_in_field, p, normal, state)
            if float(pick[1]) * 0.0001 >= cosine:
                surface_out[row, g, n] = i
                record_out[row, g, n] = pick[0]
                q_out[row, g, n] = field_seed(field, hand.kin, g, pick[0])
                n += 1
                if n == keep:
                    break
    count_out[row, g] = n


@wp.kernel
def draw_domains_bvh(
    hand: Hand,
    field: Field,
    boxes: Boxes,
    obj: Object,
    seed: wp.int32,
    attempts: wp.int32,
    keep: wp.int32,
    cosine: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    count_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array3d(dtype=wp.int32),
    record_out: wp.array3d(dtype=wp.int32),
    q_out: wp.array3d(dtype=vec_dof),
):
    """The same domains from the published index: every patch of the group is asked, a hit one is picked at random."""
    row, g = wp.tid()
    state = wp.rand_init(seed, index[row] * hand.kin.groups + g)
    T = pose[row]
    n = int(0)
    for _a in range(attempts):
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        p = wp.transform_point(T, obj.contact_points[i])
        normal = -wp.transform_vector(T, obj.contact_normals[i])
        r = boxes_pick(boxes, field, g, p, normal, cosine, state)
        if r >= 0:
            surface_out[row, g, n] = i
            record_out[row, g, n] = r
            q_out[row, g, n] = field_seed(field, hand.kin, g, r)
            n += 1
            if n == keep:
                break
    count_out[row, g] = n

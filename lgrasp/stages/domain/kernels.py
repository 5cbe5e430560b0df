"""Kernels of the domain stage: one per index of the contact field."""

import warp as wp

from lgrasp.field.arrays import Boxes, Field, boxes_pick, field_has, field_pick, field_seed
from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import vec_dof
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_NEAR = wp.constant(16.0)  # contact points before and after one that count as near it


@wp.kernel
def draw_domains(
    hand: Hand,
    field: Field,
    obj: Object,
    seed: wp.array(dtype=wp.int32),
    attempts: wp.int32,
    keep: wp.int32,
    cosine: wp.float32,
    rows: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    setting: wp.array(dtype=wp.int32),
    anchor: wp.array2d(dtype=wp.int32),
    count_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array3d(dtype=wp.int32),
    record_out: wp.array3d(dtype=wp.int32),
    q_out: wp.array3d(dtype=vec_dof),
):
    """Contact domain of each (pose, group): surface points that a contact vector of the group meets."""
    row, g = wp.tid()
    if row >= rows[0]:
        return
    slot = setting[row] * hand.kin.groups + g
    state = wp.rand_init(seed[0], index[row] * hand.kin.groups + g)
    T = pose[row]
    R = wp.transform_get_rotation(T)
    t = wp.transform_get_translation(T)
    n = int(0)
    for a in range(attempts):
        near = anchor[row, g]
        if n > 0:
            near = surface_out[row, g, a % n]
        i = int(0)
        if a < attempts // 2 or near < 0:
            i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        else:
            # few were found all over the surface: look about those
            i = wp.clamp(near + int(wp.randf(state) * (2.0 * _NEAR + 1.0)) - int(_NEAR), 0, obj.contacts - 1)
        p = wp.quat_rotate(R, obj.contact_points[i]) + t
        normal = -wp.quat_rotate(R, obj.contact_normals[i])
        row_in_field = field_has(field, slot, p, normal)
        if row_in_field >= 0:
            pick = field_pick(field, slot, row_in_field, p, normal, wp.rand_init(wp.randi(state)))
            if float(pick[1]) * 0.0001 >= cosine:
                surface_out[row, g, n] = i
                record_out[row, g, n] = pick[0]
                q_out[row, g, n] = field_seed(field, hand.kin, slot, pick[0])
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
    seed: wp.array(dtype=wp.int32),
    attempts: wp.int32,
    keep: wp.int32,
    cosine: wp.float32,
    rows: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    setting: wp.array(dtype=wp.int32),
    anchor: wp.array2d(dtype=wp.int32),
    count_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array3d(dtype=wp.int32),
    record_out: wp.array3d(dtype=wp.int32),
    q_out: wp.array3d(dtype=vec_dof),
):
    """The same domains from the published index: every patch of the group is asked, a hit one is picked at random."""
    row, g = wp.tid()
    if row >= rows[0]:
        return
    slot = setting[row] * hand.kin.groups + g
    state = wp.rand_init(seed[0], index[row] * hand.kin.groups + g)
    T = pose[row]
    n = int(0)
    for _a in range(attempts):
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        p = wp.transform_point(T, obj.contact_points[i])
        normal = -wp.transform_vector(T, obj.contact_normals[i])
        r = boxes_pick(boxes, field, slot, p, normal, cosine, wp.rand_init(wp.randi(state)))
        if r >= 0:
            surface_out[row, g, n] = i
            record_out[row, g, n] = r
            q_out[row, g, n] = field_seed(field, hand.kin, slot, r)
            n += 1
            if n == keep:
                break
    count_out[row, g] = n


@wp.kernel
def keep_frozen(
    hand: Hand,
    held: Held,
    rows: wp.array(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    count_out: wp.array2d(dtype=wp.int32),
    q_out: wp.array3d(dtype=vec_dof),
):
    """Groups that must stay as they are lose their candidates; seeds of others take over what is frozen."""
    row, g = wp.tid()
    if row >= rows[0]:
        return
    h = index[row] // held.tries
    if group_fixed(hand, held, h, g):
        count_out[row, g] = 0
    for m in range(count_out[row, g]):
        q_out[row, g, m] = with_frozen(hand, held, h, g, q_out[row, g, m])


@wp.kernel
def drop_poor(
    fingers: wp.int32,
    rows: wp.array(dtype=wp.int32),
    palm_point: wp.array(dtype=wp.int32),
    count_out: wp.array2d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """Poses where too few fingers (and the palm) can touch lose their candidates.

    ``counts_out`` grows by the poses, the rich ones and the candidates of those.
    """
    row = wp.tid()
    if row >= rows[0]:
        return
    touching = int(0)
    if palm_point[row] >= 0:
        touching = 1
    candidates = int(0)
    for g in range(count_out.shape[1]):
        if count_out[row, g] > 0:
            touching += 1
            candidates += count_out[row, g]
    wp.atomic_add(counts_out, 0, 1)
    if touching >= fingers:
        wp.atomic_add(counts_out, 1, 1)
        wp.atomic_add(counts_out, 2, candidates)
    else:
        for g in range(count_out.shape[1]):
            count_out[row, g] = 0

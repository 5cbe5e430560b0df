"""Kernel of the place stage for an opposition space: the object goes between the two sides of the space."""

import warp as wp

from lgrasp.field.arrays import Field, field_has, field_seed
from lgrasp.grasp.collision import body_clear, objects_apart
from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import MAX_JOINTS, group_forward
from lgrasp.math.transforms import rotation_between
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_DRAWS = wp.constant(16)  # of two opposite object points and a contact vector of the first side
_STRIDE = wp.constant(7919)  # between the seeds of a candidate's proposals
_TURN = wp.constant(6.2831853)


@wp.func
def _between(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    h: wp.int32,
    setting: wp.int32,
    side: wp.int32,
    fixed: wp.bool,
    other: wp.int32,
    spins: wp.int32,
    reach: wp.float32,
    state: wp.uint32,
):
    """Pose with an object point on contact surface of ``side``, and the point opposite where the field says that group
    ``other`` can touch it.

    Returns:
        Pose, hand contact point, object point on it and the object point opposite (-1: nothing was found).
    """
    c0 = hand.contacts.first[wp.where(side < 0, hand.kin.groups, side)]
    surface = hand.contacts.first[wp.where(side < 0, hand.kin.groups, side) + 1] - c0
    T = wp.transform_identity()
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = int(0)
    r0 = int(0)
    records = int(0)
    if fixed:
        records = surface
        if side >= 0:
            j0 = group_forward(hand.kin, side, held.posture[h, side], X, 0)
    else:
        slot = setting * hand.kin.groups + side
        r0 = field.start[field.cell_first[slot] * 64]
        records = field.start[field.cell_first[slot + 1] * 64] - r0
    if surface < 1 or records < 1:
        return T, int(-1), int(-1), int(-1)
    for _t in range(_DRAWS):
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        pick = wp.min(int(wp.randf(state) * float(records)), records - 1)
        first_spin = wp.randf(state, 0.0, _TURN)
        j = obj.contact_opposite[i]
        if j < 0:
            continue
        line = wp.normalize(obj.contact_points[j] - obj.contact_points[i])
        arm = obj.com - obj.contact_points[i]
        if wp.length(arm - line * wp.dot(arm, line)) > reach:
            continue
        c = c0 + pick
        if not fixed:
            c = field.point[r0 + pick]
            x = with_frozen(
                hand, held, h, side, field_seed(field, hand.kin, setting * hand.kin.groups + side, r0 + pick)
            )
            j0 = group_forward(hand.kin, side, x, X, 0)
        B = wp.transform_identity()
        if side >= 0:
            B = X[hand.contacts.body[c] - 1 - j0]
        p = wp.transform_point(B, hand.contacts.points[c])
        n = wp.transform_vector(B, hand.contacts.normals[c])
        flat = rotation_between(obj.contact_normals[i], -n)
        for s in range(spins):
            R = wp.quat_from_axis_angle(n, first_spin + _TURN * float(s) / float(spins)) * flat
            T = wp.transform(p - wp.quat_rotate(R, obj.contact_points[i]), R)
            across = wp.transform_point(T, obj.contact_points[j])
            inward = -wp.quat_rotate(R, obj.contact_normals[j])
            if field_has(field, setting * hand.kin.groups + other, across, inward) >= 0:
                return T, c, i, j
    return T, int(-1), int(-1), int(-1)


@wp.func
def _clear(hand: Hand, obj: Object, held: Held, h: wp.int32, T: wp.transform, slack: wp.float32, margin: wp.float32):
    """Is an object at T clear of the static links, the fingers that stay as they are and the held objects?"""
    T_object = wp.transform_inverse(T)
    if not body_clear(hand, obj, 0, T_object, slack):
        return False
    for k in range(held.objects):
        if not objects_apart(obj, held.object[k], wp.transform_inverse(held.pose[h, k]) * T, margin):
            return False
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    for g in range(hand.kin.groups):
        if group_fixed(hand, held, h, g):
            j0 = group_forward(hand.kin, g, held.posture[h, g], X, 0)
            for b in range(hand.kin.joint_first[g + 1] - j0):
                if not body_clear(hand, obj, 1 + j0 + b, T_object * X[b], slack):
                    return False
    return True


@wp.kernel
def propose_opposed(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    seed: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    side_a: wp.int32,
    side_b: wp.int32,
    spins: wp.int32,
    reach: wp.float32,
    clearance: wp.float32,
    margin: wp.float32,
    pose_out: wp.array2d(dtype=wp.transform),
    palm_point_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array2d(dtype=wp.int32),
    setting_out: wp.array2d(dtype=wp.int32),
    anchor_out: wp.array3d(dtype=wp.int32),
    rating_out: wp.array2d(dtype=wp.int32),
):
    """One of several poses per candidate between groups ``side_a`` and ``side_b`` (-1: static); rating 1 when it is
    clear, -1 when blocked, 0 when nothing was found.

    A side that cannot move (the palm, or a finger that holds another object) takes part with a contact point of its
    own, as the palm does elsewhere.
    """
    row, b = wp.tid()
    state = wp.rand_init(seed[0] + b * _STRIDE, first[0] + row)
    h = (first[0] + row) // held.tries
    for g in range(hand.kin.groups):
        anchor_out[row, b, g] = -1
    palm_point_out[row, b] = -1
    surface_out[row, b] = -1
    rating_out[row, b] = 0
    setting = held.setting[h]
    if setting < 0:
        setting = wp.min(int(wp.randf(state) * float(hand.kin.settings)), hand.kin.settings - 1)
    setting_out[row, b] = setting
    fixed_a = side_a < 0 or group_fixed(hand, held, h, wp.max(side_a, 0))
    fixed_b = side_b < 0 or group_fixed(hand, held, h, wp.max(side_b, 0))
    if fixed_a and fixed_b:
        return
    side = side_a
    other = side_b
    fixed = fixed_a
    if fixed_b or (not fixed_a and wp.randf(state) < 0.5):
        side = side_b
        other = side_a
        fixed = fixed_b
    draws = wp.rand_init(wp.randi(state))
    T, c, i, j = _between(hand, field, obj, held, h, setting, side, fixed, other, spins, reach, draws)
    pose_out[row, b] = T
    if j < 0:
        return
    if fixed:
        palm_point_out[row, b] = c
        surface_out[row, b] = i
    else:
        anchor_out[row, b, side] = i
    anchor_out[row, b, other] = j
    rating_out[row, b] = wp.where(_clear(hand, obj, held, h, T, clearance, margin), 1, -1)

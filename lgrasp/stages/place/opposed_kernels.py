"""Kernel of the place stage for an opposition space: the object goes between the two sides of the space."""

import warp as wp

from lgrasp.field.arrays import Field, field_has, field_seed
from lgrasp.grasp.collision import body_clear, objects_apart
from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.hand.arrays import Hand, contact_run
from lgrasp.math.kinematics import group_forward
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.math.transforms import rotation_between
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.kernels import SEED_STRIDE, no_proposal
from lgrasp.stages.place.structs import PlaceValues, ProposedPoses, Rating

wp.set_module_options(KERNEL_OPTIONS)

_DRAWS = wp.constant(16)  # of two opposite object points and a contact vector of the first side


@wp.func
def side_fixed(hand: Hand, held: Held, h: wp.int32, side: wp.int32):
    """True if a side is fixed: the static links (-1), or a finger that holds something."""
    return side < 0 or group_fixed(hand, held, h, wp.max(side, 0))


@wp.func
def _between(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    h: wp.int32,
    params: PlaceValues,
    setting: wp.int32,
    side: wp.int32,
    other: wp.int32,
    state: wp.uint32,
):
    """Pose with an object point on contact surface of ``side``, and the point opposite where the field says that group
    ``other`` can touch it.

    Returns:
        Pose, hand contact point, object point on it and the object point opposite (-1: nothing was found).
    """
    fixed = side_fixed(hand, held, h, side)
    run = contact_run(hand, setting, side)
    c0 = hand.contacts.first[run]
    surface = hand.contacts.first[run + 1] - c0
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
        first_spin = wp.randf(state, 0.0, wp.TAU)
        j = obj.contact_opposite[i]
        if j < 0:
            continue
        line = wp.normalize(obj.contact_points[j] - obj.contact_points[i])
        arm = obj.com - obj.contact_points[i]
        if wp.length(arm - line * wp.dot(arm, line)) > params.max_com_distance:
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
        for s in range(params.spins):
            R = wp.quat_from_axis_angle(n, first_spin + wp.TAU * float(s) / float(params.spins)) * flat
            T = wp.transform(p - wp.quat_rotate(R, obj.contact_points[i]), R)
            across = wp.transform_point(T, obj.contact_points[j])
            inward = -wp.quat_rotate(R, obj.contact_normals[j])
            if field_has(field, setting * hand.kin.groups + other, across, inward) >= 0:
                return T, c, i, j
    return T, int(-1), int(-1), int(-1)


@wp.func
def clear_of_hand(hand: Hand, obj: Object, held: Held, h: wp.int32, params: PlaceValues, T: wp.transform):
    """True if an object at T is clear of the static links, the fixed fingers and the held objects."""
    T_object = wp.transform_inverse(T)
    if not body_clear(hand, obj, 0, T_object, params.allowed_penetration):
        return False
    for k in range(held.objects):
        if not objects_apart(
            obj, held.object[k], wp.transform_inverse(held.pose[h, k]) * T, params.min_object_distance
        ):
            return False
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    for g in range(hand.kin.groups):
        if group_fixed(hand, held, h, g):
            j0 = group_forward(hand.kin, g, held.posture[h, g], X, 0)
            for b in range(hand.kin.joint_first[g + 1] - j0):
                if not body_clear(hand, obj, 1 + j0 + b, T_object * X[b], params.allowed_penetration):
                    return False
    return True


@wp.kernel
def propose_opposed(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    params: PlaceValues,
    seed: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    proposals_out: ProposedPoses,
):
    """One of several poses per candidate between the two sides of the space of its row, and its rating.

    A side that cannot move (the palm, or a finger that holds another object) takes part with a contact point of its
    own, as the palm does elsewhere.

    Args:
        seed: of the stage, (1,).
        first: candidate of row 0, (1,).
    """
    row, b = wp.tid()
    state = wp.rand_init(seed[0] + b * SEED_STRIDE, first[0] + row)
    h = (first[0] + row) // held.tries
    no_proposal(proposals_out, row, b)
    setting = held.setting[h]
    sides = held.sides[h]
    proposals_out.setting[row, b] = setting
    fixed_a = side_fixed(hand, held, h, sides[0])
    fixed_b = side_fixed(hand, held, h, sides[1])
    if fixed_a and fixed_b:
        return
    side = sides[0]
    other = sides[1]
    if fixed_b or (not fixed_a and wp.randf(state) < 0.5):
        side = sides[1]
        other = sides[0]
    T, c, i, j = _between(hand, field, obj, held, h, params, setting, side, other, wp.rand_init(wp.randi(state)))
    proposals_out.pose[row, b] = T
    if j < 0:
        return
    if fixed_a or fixed_b:
        proposals_out.palm_point[row, b] = c
        proposals_out.surface[row, b] = i
    else:
        proposals_out.anchor[row, b, side] = i
    proposals_out.anchor[row, b, other] = j
    if clear_of_hand(hand, obj, held, h, params, T):
        proposals_out.rating[row, b] = Rating.CLEAR
    else:
        proposals_out.rating[row, b] = Rating.BLOCKED

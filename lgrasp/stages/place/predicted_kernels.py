"""Kernel of the place stage for predicted poses: the object is moved until it is between the two sides of a space."""

import warp as wp

from lgrasp.field.arrays import Field, field_has
from lgrasp.grasp.held import Held, with_frozen
from lgrasp.grasp.predicted import Predicted, contact_place, touching_points
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import vec_dof
from lgrasp.math.transforms import rotation_between, tangent
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.kernels import SEED_STRIDE, no_proposal
from lgrasp.stages.place.opposed_kernels import clear_of_hand, side_fixed
from lgrasp.stages.place.structs import PlaceValues, ProposedPoses, Rating

wp.set_module_options(KERNEL_OPTIONS)

_DRAWS = wp.constant(8)  # of points of the object near the one that was predicted, and of rolls
_NEIGHBOURS = wp.constant(32.0)  # contact points before and after one, in order, that are tried
_MOST_ROLL = wp.constant(0.35)  # [rad]
_ALLOWED_TILT = wp.constant(0.1)  # [rad] between the normals at a contact that stays as predicted
_OPPOSED = wp.constant(0.9)  # least cosine of the line between two contacts and their normals
_AS_PREDICTED = wp.constant(3)  # rating of the prediction itself, moved onto the hand
_NEARBY = wp.constant(2)  # of other poses near it


@wp.func
def _opposed(obj: Object, i: wp.int32, j: wp.int32, reach: wp.float32):
    """True if two contact points of an object face away from each other, and the line between them is within ``reach``
    [m] of the centre of mass."""
    line = wp.normalize(obj.contact_points[j] - obj.contact_points[i])
    arm = obj.com - obj.contact_points[i]
    if wp.length(arm - line * wp.dot(arm, line)) > reach:
        return False
    return wp.dot(line, obj.contact_normals[j]) > _OPPOSED and -wp.dot(line, obj.contact_normals[i]) > _OPPOSED


@wp.func
def _pressed(obj: Object, T: wp.transform, i: wp.int32, p: wp.vec3, n: wp.vec3, roll: wp.float32):
    """Pose of an object near T whose contact point i is on a contact at p with outward normal n, rolled about it."""
    R = wp.transform_get_rotation(T)
    R = rotation_between(wp.quat_rotate(R, obj.contact_normals[i]), -n) * R
    R = wp.normalize(wp.quat_from_axis_angle(n, roll) * R)
    return wp.transform(p - wp.quat_rotate(R, obj.contact_points[i]), R)


@wp.func
def _laid(obj: Object, T: wp.transform, i: wp.int32, p: wp.vec3, n: wp.vec3):
    """Pose of an object near T, turned no more than it must and moved along n alone, such that its contact point i is
    in the tangent plane of a contact at p with outward normal n."""
    R = wp.transform_get_rotation(T)
    x = wp.transform_point(T, obj.contact_points[i])
    m = wp.quat_rotate(R, obj.contact_normals[i])
    angle = wp.acos(wp.clamp(-wp.dot(m, n), -1.0, 1.0))
    if angle > _ALLOWED_TILT:
        axis = wp.cross(m, -n)
        if wp.length(axis) < 1.0e-6:
            axis = tangent(n)
        R = wp.normalize(wp.quat_from_axis_angle(wp.normalize(axis), angle - _ALLOWED_TILT) * R)
    x = x + n * wp.dot(p - x, n)
    return wp.transform(x - wp.quat_rotate(R, obj.contact_points[i]), R)


@wp.kernel
def propose_predicted(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    predicted: Predicted,
    params: PlaceValues,
    seed: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    proposals_out: ProposedPoses,
):
    """Poses near the predicted one of each candidate, between the two sides of the space of its row, and ratings.

    The first proposal is the prediction, its object moved and turned until it touches the side that cannot move where
    it was nearest; it counts if the other side is then opposite. The others put some object point nearby on a side (of
    two that can move, with joints as predicted) such that the field says that the other side can touch the point
    opposite.

    Args:
        seed: of the stage, (1,).
        first: candidate of row 0, (1,).
    """
    row, b = wp.tid()
    candidate = first[0] + row
    state = wp.rand_init(seed[0] + b * SEED_STRIDE, candidate)
    h = candidate // held.tries
    setting = held.setting[h]
    sides = held.sides[h]
    T = predicted.pose[candidate]
    no_proposal(proposals_out, row, b)
    proposals_out.setting[row, b] = setting
    proposals_out.pose[row, b] = T
    fixed_a = side_fixed(hand, held, h, sides[0])
    fixed_b = side_fixed(hand, held, h, sides[1])
    if fixed_a and fixed_b:
        return
    side = sides[0]
    other = sides[1]
    place = int(0)
    if fixed_b or (not fixed_a and b % 2 == 1):
        side = sides[1]
        other = sides[0]
        place = int(1)
    moves = not fixed_a and not fixed_b
    x = vec_dof()
    if moves:
        x = with_frozen(hand, held, h, side, predicted.posture[candidate, side])
    elif side >= 0:
        x = held.posture[h, side]
    c = predicted.hand_point[candidate, place]
    nearest = predicted.object_point[candidate, place]
    if nearest < 0:
        return
    p, n = contact_place(hand, side, x, c)
    if b == 0:
        P = T
        if not moves:
            P = _laid(obj, T, nearest, p, n)
        y = with_frozen(hand, held, h, other, predicted.posture[candidate, other])
        _c2, _p2, _n2, j = touching_points(hand, obj, P, setting, other, y)
        if j < 0:
            return
        if _opposed(obj, nearest, j, params.max_com_distance):
            proposals_out.pose[row, b] = P
            proposals_out.anchor[row, b, other] = j
            if moves:
                proposals_out.anchor[row, b, side] = nearest
            else:
                proposals_out.palm_point[row, b] = c
                proposals_out.surface[row, b] = nearest
            proposals_out.rating[row, b] = Rating.BLOCKED
            if clear_of_hand(hand, obj, held, h, params, P):
                proposals_out.rating[row, b] = _AS_PREDICTED
        return
    for _t in range(_DRAWS):
        i = wp.clamp(nearest + int((2.0 * wp.randf(state) - 1.0) * _NEIGHBOURS), 0, obj.contacts - 1)
        roll = (2.0 * wp.randf(state) - 1.0) * _MOST_ROLL
        j = obj.contact_opposite[i]
        if j < 0:
            continue
        if not _opposed(obj, i, j, params.max_com_distance):
            continue
        P = _pressed(obj, T, i, p, n, roll)
        across = wp.transform_point(P, obj.contact_points[j])
        inward = -wp.quat_rotate(wp.transform_get_rotation(P), obj.contact_normals[j])
        if field_has(field, setting * hand.kin.groups + other, across, inward) < 0:
            continue
        proposals_out.pose[row, b] = P
        if moves:
            proposals_out.anchor[row, b, side] = i
        else:
            proposals_out.palm_point[row, b] = c
            proposals_out.surface[row, b] = i
        proposals_out.anchor[row, b, other] = j
        proposals_out.rating[row, b] = Rating.BLOCKED
        if clear_of_hand(hand, obj, held, h, params, P):
            proposals_out.rating[row, b] = _NEARBY
            break

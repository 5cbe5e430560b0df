"""Kernels of the place stage (Lightning Grasp, 5.2): poses are proposed, the best is chosen, the rest is dropped."""

import numpy as np
import warp as wp

from lgrasp.field.arrays import Field, field_has, field_pair, field_seed
from lgrasp.grasp.collision import body_clear, body_depth, body_height, resting_plane
from lgrasp.grasp.predicted import touching_points
from lgrasp.grasp.structs import Poses
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_forward, vec_dof
from lgrasp.math.limits import MAX_GROUPS, MAX_JOINTS
from lgrasp.math.sdf import sdf_gradient
from lgrasp.math.transforms import random_rotation, rotation_between
from lgrasp.object.arrays import Object
from lgrasp.policy.arrays import Network
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.rating import rate_pose
from lgrasp.stages.place.structs import PlaceCount, PlaceValues, ProposedPoses, Rating
from lgrasp.steer.arrays import Steer, pick_group
from lgrasp.steer.cone import in_cone, roll_in_cone, rotation_in_cone

wp.set_module_options(KERNEL_OPTIONS)

SEED_STRIDE = wp.constant(7919)
"""Between the seeds of a candidate's proposals."""
_PINCH_DRAWS = wp.constant(32)  # of two opposite points and two opposed contact vectors
_PINCH_TOLERANCE = wp.constant(0.002)  # [m] difference of their distances
_PINCH_ROLL_SIGMA = wp.constant(0.3)  # [rad] about the roll that brings the first normals together
_PINCH_MIN_SINE = wp.constant(0.1)  # of a normal to the line; below that any roll is as good
_CONE_DRAWS = wp.constant(32)  # of points of object and hand whose roll may bring the palm into its cone
_TOUCH_GAP = wp.constant(0.001)  # [m] of a palm that touches at a pose that is asked for
_TOUCH_COSINE = wp.constant(float(np.cos(np.radians(30.0))))  # of its normal and the object's
_PALM_COSINE = wp.constant(float(np.cos(np.radians(14.0))))  # of a pinched object's normal to the palm's


@wp.func
def no_proposal(proposals_out: ProposedPoses, row: wp.int32, b: wp.int32):
    """A proposal of nothing, to be filled in; its pose and setting are not written."""
    for g in range(proposals_out.anchor.shape[2]):
        proposals_out.anchor[row, b, g] = -1
    proposals_out.palm_point[row, b] = -1
    proposals_out.resting[row, b] = -1
    proposals_out.surface[row, b] = -1
    proposals_out.rating[row, b] = Rating.HOPELESS


@wp.func
def _aligned(p: wp.vec3, n: wp.vec3, point: wp.vec3, normal: wp.vec3, steer: Steer, state: wp.uint32):
    """Pose that puts object point on p with opposite normals, with a random roll about the normal of those that are
    asked for; and whether there is one."""
    R = rotation_between(normal, -n)
    found = bool(True)
    roll = float(0.0)
    if steer.cosine < -1.0:
        roll = wp.randf(state, 0.0, wp.TAU)
    else:
        roll, found = roll_in_cone(steer, R, n, wp.randf(state))
    R = wp.quat_from_axis_angle(n, roll) * R
    return wp.transform(p - wp.quat_rotate(R, point), R), found


@wp.func
def _pinch(hand: Hand, field: Field, obj: Object, steer: Steer, anchor: wp.array(dtype=wp.int32), state: wp.uint32):
    """Pose that puts two opposite object points between two fingers, or finger and palm, that press towards each other.

    ``anchor`` gets the two points; all of them stay below 0 when no pose was found.

    Returns:
        Pose, setting, palm contact (-1: none) and the object point on it.
    """
    G = hand.kin.groups
    T = wp.transform_identity()
    for _t in range(_PINCH_DRAWS):
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        j = obj.contact_opposite[i]
        if j < 0:
            continue
        line = obj.contact_points[j] - obj.contact_points[i]
        width = wp.length(line)
        pair = field_pair(field, width, _PINCH_TOLERANCE, wp.randf(state))
        if pair < 0:
            continue
        a = field.pair_point[pair, 0]
        b = field.pair_point[pair, 1]
        axis = wp.normalize(b - a)
        R = rotation_between(line / width, axis)
        # the roll that brings the first normals together, unless they are along the line
        have = -wp.quat_rotate(R, obj.contact_normals[i])
        want = field.pair_normal[pair, 0]
        side = wp.cross(have, axis)
        x = wp.dot(want - axis * wp.dot(want, axis), have - axis * wp.dot(have, axis))
        y = wp.dot(wp.cross(have, want), axis)
        angle = wp.atan2(y, x) + _PINCH_ROLL_SIGMA * wp.randn(state)
        if wp.length(side) < _PINCH_MIN_SINE or wp.length(wp.cross(want, axis)) < _PINCH_MIN_SINE:
            angle = wp.randf(state, 0.0, wp.TAU)
            if steer.cosine >= -1.0:
                angle, _ = roll_in_cone(steer, R, axis, wp.randf(state))
        R = wp.quat_from_axis_angle(axis, angle) * R
        if not in_cone(steer, R):
            continue
        middle = 0.5 * (obj.contact_points[i] + obj.contact_points[j])
        T = wp.transform(0.5 * (a + b) - wp.quat_rotate(R, middle), R)
        slot = field.pair_slot[pair]
        palm = wp.max(-1 - slot[1], -1)
        if palm >= 0:
            T = wp.transform(b - wp.quat_rotate(R, obj.contact_points[j]), R)
        p = wp.transform_point(T, obj.contact_points[i])
        if field_has(field, slot[0], p, -wp.quat_rotate(R, obj.contact_normals[i])) < 0:
            continue
        across = -wp.quat_rotate(R, obj.contact_normals[j])
        if palm >= 0:
            if wp.dot(hand.contacts.normals[palm], across) < _PALM_COSINE:
                continue
        elif field_has(field, slot[1], wp.transform_point(T, obj.contact_points[j]), across) < 0:
            continue
        setting = slot[0] // G
        anchor[slot[0] - setting * G] = i
        if palm < 0:
            anchor[slot[1] - setting * G] = j
        return T, setting, palm, j
    return T, int(-1), int(-1), int(-1)


@wp.func
def _draw_resting(obj: Object, state: wp.uint32):
    """A resting pose of an object, drawn by the shares; -1: it rests on nothing."""
    pose = int(-1)
    u = wp.randf(state)
    for k in range(obj.resting.count):
        if pose < 0 and u < obj.resting.upto[k]:
            pose = k
    return pose


@wp.func
def _palm_touch(hand: Hand, obj: Object, steer: Steer, T: wp.transform):
    """Palm contact that may touch, and does at a pose, and the object point on it; -1, -1: none."""
    palm, p, n, i = touching_points(hand, obj, T, 0, -1, vec_dof())
    allowed = bool(False)
    for k in range(steer.palm_points.shape[0]):
        allowed = allowed or steer.palm_points[k] == palm
    if not allowed or i < 0:
        return int(-1), int(-1)
    T_object = wp.transform_inverse(T)
    e = sdf_gradient(obj.sdf, wp.transform_point(T_object, p))
    facing = -wp.dot(wp.transform_vector(T_object, n), wp.vec3(e[0], e[1], e[2]))
    if wp.abs(e[3]) > _TOUCH_GAP or facing < _TOUCH_COSINE:
        return int(-1), int(-1)
    return palm, i


@wp.func
def rate_there(
    hand: Hand,
    field: Field,
    obj: Object,
    params: PlaceValues,
    policy: Network,
    groups: wp.int32,
    T: wp.transform,
    resting: wp.int32,
    setting: wp.int32,
    palm: wp.int32,
    anchor: wp.array(dtype=wp.int32),
    state: wp.uint32,
):
    """The rating of a pose (:func:`rate_pose`), or a Rating where static links or the table block it."""
    if not body_clear(hand, obj, 0, wp.transform_inverse(T), params.allowed_penetration):
        return int(Rating.BLOCKED)
    plane = resting_plane(obj, T, resting)
    above = params.min_table_distance
    if body_height(hand.pieces, 0, wp.transform_identity(), plane, above) < above:
        return int(Rating.BLOCKED)
    if params.samples == 0 and policy.rows.shape[0] == 0:
        return int(Rating.CLEAR)
    numbers = wp.rand_init(wp.randi(state))
    return rate_pose(hand, field, obj, params, policy, groups, T, plane, setting, palm, anchor, numbers)


@wp.kernel
def propose_poses(
    hand: Hand,
    field: Field,
    obj: Object,
    params: PlaceValues,
    steer: Steer,
    policy: Network,
    seed: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    proposals_out: ProposedPoses,
):
    """One of several poses per candidate, and its rating.

    Functions get random states of their own: one handed over is a copy, so that its numbers would come again here.

    Args:
        seed: of the stage, (1,).
        first: candidate of row 0, (1,).
    """
    row, b = wp.tid()
    state = wp.rand_init(seed[0] + b * SEED_STRIDE, first[0] + row)
    G = hand.kin.groups
    palms = steer.palm_points.shape[0]
    u = wp.randf(state)
    i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
    palm = int(-1)
    anchor = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.int32)
    for k in range(G):
        anchor[k] = -1
    setting = int(0)
    if hand.kin.settings > 1:
        setting = wp.min(int(wp.randf(state) * float(hand.kin.settings)), hand.kin.settings - 1)
    T = wp.transform_identity()
    rating = int(Rating.BLOCKED)
    tries = wp.where(steer.cosine < -1.0, 1, _CONE_DRAWS)
    found = bool(True)
    if steer.poses.shape[0] > 0:
        T = steer.poses[(first[0] + row) % steer.poses.shape[0]]
        palm, i = _palm_touch(hand, obj, steer, T)
    elif u < params.canonical:
        x = wp.vec3(wp.randf(state), wp.randf(state), wp.randf(state))
        p = hand.box_low + wp.cw_mul(x, hand.box_high - hand.box_low)
        R = wp.quat_identity()
        if steer.cosine < -1.0:
            R = random_rotation(wp.rand_init(wp.randi(state)))
        else:
            R = rotation_in_cone(steer, wp.rand_init(wp.randi(state)))
        T = wp.transform(p - wp.quat_rotate(R, obj.contact_points[i]), R)
    elif u < params.canonical + params.pinch:
        T, setting, palm, i = _pinch(hand, field, obj, steer, anchor, wp.rand_init(wp.randi(state)))
        if setting < 0:
            rating = Rating.HOPELESS
    elif u < params.canonical + params.pinch + params.palm and palms > 0:
        for t in range(tries):
            if t > 0:
                i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
            palm = steer.palm_points[wp.min(int(wp.randf(state) * float(palms)), palms - 1)]
            p = hand.contacts.points[palm]
            n = hand.contacts.normals[palm]
            draws = wp.rand_init(wp.randi(state))
            T, found = _aligned(p, n, obj.contact_points[i], obj.contact_normals[i], steer, draws)
            if found:
                break
    else:
        g = pick_group(steer.groups, wp.randf(state))
        slot = setting * G + g
        r0 = field.start[field.cell_first[slot] * 64]
        r1 = field.start[field.cell_first[slot + 1] * 64]
        if r1 > r0:
            X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
            for t in range(tries):
                if t > 0:
                    i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
                r = r0 + wp.min(int(wp.randf(state) * float(r1 - r0)), r1 - r0 - 1)
                j0 = group_forward(hand.kin, g, field_seed(field, hand.kin, slot, r), X, 0)
                c = field.point[r]
                B = X[hand.contacts.body[c] - 1 - j0]
                p = wp.transform_point(B, hand.contacts.points[c])
                n = wp.transform_vector(B, hand.contacts.normals[c])
                draws = wp.rand_init(wp.randi(state))
                T, found = _aligned(p, n, obj.contact_points[i], obj.contact_normals[i], steer, draws)
                if found:
                    break
            anchor[g] = i
        else:
            rating = Rating.HOPELESS
    if not found:
        rating = Rating.HOPELESS
    # the same of all proposals: else those that are hard to reach would lose against the others
    resting = _draw_resting(obj, wp.rand_init(seed[0] - SEED_STRIDE, first[0] + row))
    if rating != Rating.HOPELESS:
        rating = rate_there(hand, field, obj, params, policy, steer.groups, T, resting, setting, palm, anchor, state)
    proposals_out.pose[row, b] = T
    proposals_out.palm_point[row, b] = palm
    proposals_out.surface[row, b] = i
    proposals_out.setting[row, b] = setting
    proposals_out.resting[row, b] = resting
    for k in range(G):
        proposals_out.anchor[row, b, k] = anchor[k]
    proposals_out.rating[row, b] = rating


@wp.kernel
def choose_poses(
    hand: Hand,
    obj: Object,
    params: PlaceValues,
    proposals: ProposedPoses,
    chosen_out: wp.array(dtype=wp.int32),
    kept_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """The best rated proposal of each candidate that is clear of static links to the last point, if there is one.

    Args:
        chosen_out: the proposal, -1 none, (N,).
        kept_out: 1 if there is one, (N,).
        counts_out: PlaceCount, (3,).
    """
    row = wp.tid()
    choices = proposals.rating.shape[1]
    chosen = int(-1)
    best = int(Rating.BLOCKED)
    for b in range(choices):
        if proposals.rating[row, b] == Rating.HOPELESS:
            best = Rating.HOPELESS
    ceiling = int(1 << 30)
    after = int(-1)
    for _try in range(choices):
        # the next in order of ratings, earlier proposals first
        pick = int(-1)
        highest = int(Rating.HOPELESS)
        for b in range(choices):
            r = proposals.rating[row, b]
            if r > highest and (r < ceiling or (r == ceiling and b > after)):
                pick = b
                highest = r
        if pick < 0:
            break
        ceiling = highest
        after = pick
        T_object = wp.transform_inverse(proposals.pose[row, pick])
        if body_depth(hand, obj, 0, T_object, params.allowed_penetration) <= params.allowed_penetration:
            chosen = pick
            best = ceiling
            break
    chosen_out[row] = chosen
    kept_out[row] = wp.where(chosen >= 0, 1, 0)
    wp.atomic_add(counts_out, PlaceCount.TRIED, 1)
    if best == Rating.BLOCKED:
        wp.atomic_add(counts_out, PlaceCount.BLOCKED, 1)
    if chosen >= 0:
        wp.atomic_add(counts_out, PlaceCount.KEPT, 1)


@wp.kernel
def take_poses(
    upto: wp.array(dtype=wp.int32),
    chosen: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    proposals: ProposedPoses,
    poses_out: Poses,
):
    """Rows of the PoseTable: the chosen proposals.

    Args:
        upto: chosen ones among the first ``row + 1`` candidates, (N,).
        chosen: the proposal, -1 none, (N,).
        first: candidate of row 0, (1,).
    """
    row = wp.tid()
    if row == upto.shape[0] - 1:
        poses_out.rows[0] = upto[row]
    b = chosen[row]
    if b < 0:
        return
    i = upto[row] - 1
    palm_point = proposals.palm_point[row, b]
    poses_out.index[i] = first[0] + row
    poses_out.pose[i] = proposals.pose[row, b]
    poses_out.palm_point[i] = palm_point
    poses_out.palm_surface[i] = wp.where(palm_point >= 0, proposals.surface[row, b], -1)
    poses_out.setting[i] = proposals.setting[row, b]
    poses_out.resting[i] = proposals.resting[row, b]
    for k in range(proposals.anchor.shape[2]):
        poses_out.anchor[i, k] = proposals.anchor[row, b, k]

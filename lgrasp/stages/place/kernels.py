"""Kernels of the place stage: poses are proposed, the best is chosen, the rest is dropped."""

import numpy as np
import warp as wp

from lgrasp.field.arrays import Field, field_has, field_pair, field_seed
from lgrasp.grasp.collision import body_clear, body_depth
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import MAX_GROUPS, MAX_JOINTS, group_forward
from lgrasp.math.transforms import random_rotation, rotation_between
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_HITS = wp.constant(6)  # rated contacts per group
_MAX_RATED = wp.constant(48)
_STRIDE = wp.constant(7919)  # between the seeds of a candidate's proposals
_PINCHES = wp.constant(32)  # draws of two opposite points and two opposed contact vectors
_PALM_COS = wp.constant(float(np.cos(np.radians(14.0))))  # of a pinched object's normal to the palm's
_PINCH_SLACK = wp.constant(0.002)  # [m] difference of their distances


@wp.func
def _aligned(p: wp.vec3, n: wp.vec3, point: wp.vec3, normal: wp.vec3, state: wp.uint32):
    """Pose that puts object point on p with opposite normals, and a random roll about the normal."""
    roll = wp.quat_from_axis_angle(n, wp.randf(state, 0.0, 6.2831853))
    R = roll * rotation_between(normal, -n)
    return wp.transform(p - wp.quat_rotate(R, point), R)


@wp.func
def _pinch(hand: Hand, field: Field, obj: Object, anchor: wp.array(dtype=wp.int32), state: wp.uint32):
    """Pose that puts two opposite object points between two fingers, or finger and palm, that press towards each other.

    ``anchor`` gets the two points; all of them stay below 0 when no pose was found.

    Returns:
        Pose, setting, palm contact (-1: none) and the object point on it.
    """
    G = hand.kin.groups
    T = wp.transform_identity()
    for _t in range(_PINCHES):
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        j = obj.contact_opposite[i]
        if j < 0:
            continue
        line = obj.contact_points[j] - obj.contact_points[i]
        width = wp.length(line)
        pair = field_pair(field, width, _PINCH_SLACK, wp.randf(state))
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
        angle = wp.atan2(y, x) + 0.3 * wp.randn(state)
        if wp.length(side) < 0.1 or wp.length(wp.cross(want, axis)) < 0.1:
            angle = wp.randf(state, 0.0, 6.2831853)
        R = wp.quat_from_axis_angle(axis, angle) * R
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
            if wp.dot(hand.contacts.normals[palm], across) < _PALM_COS:
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
def rate_pose(
    hand: Hand,
    field: Field,
    obj: Object,
    T: wp.transform,
    setting: wp.int32,
    palm: wp.int32,
    samples: wp.int32,
    reach: wp.float32,
    anchor: wp.array(dtype=wp.int32),
    state: wp.uint32,
):
    """How many pairs of reachable contacts of different groups oppose each other about the centre of mass.

    A pair counts when each contact's inward normal is within 40 degrees of the line to the other, and the line passes
    the centre of mass within ``reach`` [m]. ``anchor`` holds an object contact point that each group can touch, or gets
    one.
    """
    com = wp.transform_point(T, obj.com)
    points = wp.zeros(shape=(_MAX_RATED,), dtype=wp.vec3)
    normals = wp.zeros(shape=(_MAX_RATED,), dtype=wp.vec3)
    owner = wp.zeros(shape=(_MAX_RATED,), dtype=wp.int32)
    m = int(0)
    R = wp.transform_get_rotation(T)
    t = wp.transform_get_translation(T)
    for g in range(hand.kin.groups):
        hits = int(0)
        for s in range(samples):
            i = anchor[g]
            if s > 0 or i < 0:
                i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
            p = wp.quat_rotate(R, obj.contact_points[i]) + t
            n = -wp.quat_rotate(R, obj.contact_normals[i])
            if field_has(field, setting * hand.kin.groups + g, p, n) >= 0:
                points[m] = p
                normals[m] = n
                owner[m] = g
                m += 1
                hits += 1
                if anchor[g] < 0:
                    anchor[g] = i
                if hits == _HITS or m == _MAX_RATED - 1:
                    break
    if palm >= 0:
        points[m] = hand.contacts.points[palm]
        normals[m] = hand.contacts.normals[palm]
        owner[m] = -1
        m += 1
    rating = int(0)
    for i in range(m):
        for j in range(i):
            if owner[i] != owner[j]:
                d = points[j] - points[i]
                a = wp.dot(d, normals[i])
                b = -wp.dot(d, normals[j])
                # hand normals point into the object, so towards each other
                limit = 0.766 * wp.length(d)
                if a > limit and b > limit:
                    u = wp.clamp(wp.dot(com - points[i], d) / wp.dot(d, d), 0.0, 1.0)
                    if wp.length(com - points[i] - d * u) < reach:
                        rating += 1
    return rating


@wp.kernel
def propose_poses(
    hand: Hand,
    field: Field,
    obj: Object,
    seed: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    canonical: wp.float32,
    pinch: wp.float32,
    palm_share: wp.float32,
    samples: wp.int32,
    reach: wp.float32,
    clearance: wp.float32,
    pose_out: wp.array2d(dtype=wp.transform),
    palm_point_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array2d(dtype=wp.int32),
    setting_out: wp.array2d(dtype=wp.int32),
    anchor_out: wp.array3d(dtype=wp.int32),
    rating_out: wp.array2d(dtype=wp.int32),
):
    """One of several poses per candidate, and its rating; -1: not clear of static links, 0: it can hold nothing.

    Functions get random states of their own: one handed over is a copy, so that its numbers would come again here.
    """
    row, b = wp.tid()
    state = wp.rand_init(seed[0] + b * _STRIDE, first[0] + row)
    G = hand.kin.groups
    palm0 = hand.contacts.first[G]
    palms = hand.contacts.first[G + 1] - palm0
    u = wp.randf(state)
    i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
    point = obj.contact_points[i]
    normal = obj.contact_normals[i]
    palm = int(-1)
    anchor = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.int32)
    for k in range(G):
        anchor[k] = -1
    setting = int(0)
    if hand.kin.settings > 1:
        setting = wp.min(int(wp.randf(state) * float(hand.kin.settings)), hand.kin.settings - 1)
    T = wp.transform_identity()
    rating = int(-1)
    if u < canonical:
        x = wp.vec3(wp.randf(state), wp.randf(state), wp.randf(state))
        p = hand.box_low + wp.cw_mul(x, hand.box_high - hand.box_low)
        R = random_rotation(wp.rand_init(wp.randi(state)))
        T = wp.transform(p - wp.quat_rotate(R, point), R)
    elif u < canonical + pinch:
        T, setting, palm, i = _pinch(hand, field, obj, anchor, wp.rand_init(wp.randi(state)))
        if setting < 0:
            rating = 0
    elif u < canonical + pinch + palm_share and palms > 0:
        palm = palm0 + wp.min(int(wp.randf(state) * float(palms)), palms - 1)
        n = hand.contacts.normals[palm]
        T = _aligned(hand.contacts.points[palm], n, point, normal, wp.rand_init(wp.randi(state)))
    else:
        g = wp.min(int(wp.randf(state) * float(G)), G - 1)
        slot = setting * G + g
        r0 = field.start[field.cell_first[slot] * 64]
        r1 = field.start[field.cell_first[slot + 1] * 64]
        if r1 > r0:
            r = r0 + wp.min(int(wp.randf(state) * float(r1 - r0)), r1 - r0 - 1)
            X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
            j0 = group_forward(hand.kin, g, field_seed(field, hand.kin, slot, r), X, 0)
            c = field.point[r]
            B = X[hand.contacts.body[c] - 1 - j0]
            p = wp.transform_point(B, hand.contacts.points[c])
            n = wp.transform_vector(B, hand.contacts.normals[c])
            T = _aligned(p, n, point, normal, wp.rand_init(wp.randi(state)))
            anchor[g] = i
        else:
            rating = 0
    if rating < 0 and body_clear(hand, obj, 0, wp.transform_inverse(T), clearance):
        rating = 1
        if samples > 0:
            own = wp.rand_init(wp.randi(state))
            rating = rate_pose(hand, field, obj, T, setting, palm, samples, reach, anchor, own)
    pose_out[row, b] = T
    palm_point_out[row, b] = palm
    surface_out[row, b] = i
    setting_out[row, b] = setting
    for k in range(G):
        anchor_out[row, b, k] = anchor[k]
    rating_out[row, b] = rating


@wp.kernel
def choose_poses(
    hand: Hand,
    obj: Object,
    clearance: wp.float32,
    pose: wp.array2d(dtype=wp.transform),
    rating: wp.array2d(dtype=wp.int32),
    chosen_out: wp.array(dtype=wp.int32),
    kept_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """The best rated proposal of each candidate that is clear of static links to the last point, if there is one.

    ``counts_out`` grows by those tried, blocked and kept.
    """
    row = wp.tid()
    chosen = int(-1)
    best = int(-1)
    for b in range(rating.shape[1]):
        if rating[row, b] == 0:
            best = 0
    ceiling = int(1 << 30)
    after = int(-1)
    for _try in range(rating.shape[1]):
        # the next in order of ratings, earlier proposals first
        pick = int(-1)
        for b in range(rating.shape[1]):
            r = rating[row, b]
            if r > 0 and (r < ceiling or (r == ceiling and b > after)) and (pick < 0 or r > rating[row, pick]):
                pick = b
        if pick < 0:
            break
        ceiling = rating[row, pick]
        after = pick
        if body_depth(hand, obj, 0, wp.transform_inverse(pose[row, pick]), clearance) <= clearance:
            chosen = pick
            best = ceiling
            break
    chosen_out[row] = chosen
    kept_out[row] = wp.where(best > 0, 1, 0)
    wp.atomic_add(counts_out, 0, 1)
    if best < 0:
        wp.atomic_add(counts_out, 1, 1)
    if best > 0:
        wp.atomic_add(counts_out, 2, 1)


@wp.kernel
def take_poses(
    upto: wp.array(dtype=wp.int32),
    chosen: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    pose: wp.array2d(dtype=wp.transform),
    palm_point: wp.array2d(dtype=wp.int32),
    surface: wp.array2d(dtype=wp.int32),
    setting: wp.array2d(dtype=wp.int32),
    anchor: wp.array3d(dtype=wp.int32),
    index_out: wp.array(dtype=wp.int32),
    pose_out: wp.array(dtype=wp.transform),
    palm_point_out: wp.array(dtype=wp.int32),
    palm_surface_out: wp.array(dtype=wp.int32),
    setting_out: wp.array(dtype=wp.int32),
    anchor_out: wp.array2d(dtype=wp.int32),
    rows_out: wp.array(dtype=wp.int32),
):
    """Rows of the PoseTable: the chosen proposals, ``upto[row]`` of them among the first ``row + 1`` candidates."""
    row = wp.tid()
    if row == upto.shape[0] - 1:
        rows_out[0] = upto[row]
    b = chosen[row]
    if b < 0:
        return
    i = upto[row] - 1
    index_out[i] = first[0] + row
    pose_out[i] = pose[row, b]
    palm_point_out[i] = palm_point[row, b]
    palm_surface_out[i] = wp.where(palm_point[row, b] >= 0, surface[row, b], -1)
    setting_out[i] = setting[row, b]
    for k in range(anchor.shape[2]):
        anchor_out[i, k] = anchor[row, b, k]

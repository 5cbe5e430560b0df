"""Kernel of the place stage."""

import warp as wp

from lgrasp.device.kinematics import MAX_JOINTS, group_forward
from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.device.transforms import random_rotation, rotation_between
from lgrasp.field.arrays import Field, field_has, field_seed
from lgrasp.grasp.clearance import body_clear, body_depth
from lgrasp.hand.arrays import Hand
from lgrasp.object.arrays import Object

__all__ = ["place_objects"]

wp.set_module_options(KERNEL_OPTIONS)

_HITS = wp.constant(6)  # rated contacts per group
_MAX_RATED = wp.constant(48)


@wp.func
def _aligned(p: wp.vec3, n: wp.vec3, point: wp.vec3, normal: wp.vec3, state: wp.uint32):
    """Pose that puts object point on p with opposite normals, and a random roll about the normal."""
    roll = wp.quat_from_axis_angle(n, wp.randf(state, 0.0, 6.2831853))
    R = roll * rotation_between(normal, -n)
    return wp.transform(p - wp.quat_rotate(R, point), R)


@wp.func
def rate_pose(
    hand: Hand, field: Field, obj: Object, T: wp.transform, palm: wp.int32, samples: wp.int32, state: wp.uint32
):
    """How many pairs of reachable contacts of different groups oppose each other.

    A pair counts when each contact's inward normal is within 40 degrees of the line to the other.
    """
    points = wp.zeros(shape=(_MAX_RATED,), dtype=wp.vec3)
    normals = wp.zeros(shape=(_MAX_RATED,), dtype=wp.vec3)
    owner = wp.zeros(shape=(_MAX_RATED,), dtype=wp.int32)
    m = int(0)
    R = wp.transform_get_rotation(T)
    t = wp.transform_get_translation(T)
    for g in range(hand.kin.groups):
        hits = int(0)
        for _s in range(samples):
            i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
            p = wp.quat_rotate(R, obj.contact_points[i]) + t
            n = -wp.quat_rotate(R, obj.contact_normals[i])
            if field_has(field, g, p, n) >= 0:
                points[m] = p
                normals[m] = n
                owner[m] = g
                m += 1
                hits += 1
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
                    rating += 1
    return rating


@wp.kernel
def place_objects(
    hand: Hand,
    field: Field,
    obj: Object,
    seed: wp.int32,
    first: wp.int32,
    canonical: wp.float32,
    exhaustive: wp.float32,
    proposals: wp.int32,
    samples: wp.int32,
    clearance: wp.float32,
    pose_out: wp.array(dtype=wp.transform),
    palm_point_out: wp.array(dtype=wp.int32),
    palm_surface_out: wp.array(dtype=wp.int32),
    rating_out: wp.array(dtype=wp.int32),
):
    """The best of several clear poses per candidate; rating -1: none was clear of static links, 0: none can hold."""
    row = wp.tid()
    state = wp.rand_init(seed, first + row)
    G = hand.kin.groups
    palm0 = hand.contacts.first[G]
    palms = hand.contacts.first[G + 1] - palm0
    best = int(-1)
    for _b in range(proposals):
        u = wp.randf(state)
        i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
        point = obj.contact_points[i]
        normal = obj.contact_normals[i]
        palm = int(-1)
        T = wp.transform_identity()
        if u < canonical:
            x = wp.vec3(wp.randf(state), wp.randf(state), wp.randf(state))
            p = hand.box_low + wp.cw_mul(x, hand.box_high - hand.box_low)
            R = random_rotation(state)
            T = wp.transform(p - wp.quat_rotate(R, point), R)
        elif u < canonical + exhaustive or palms == 0:
            g = wp.min(int(wp.randf(state) * float(G)), G - 1)
            r0 = field.start[field.cell_first[g] * 64]
            r1 = field.start[field.cell_first[g + 1] * 64]
            if r1 > r0:
                r = r0 + wp.min(int(wp.randf(state) * float(r1 - r0)), r1 - r0 - 1)
                X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
                j0 = group_forward(hand.kin, g, field_seed(field, hand.kin, g, r), X, 0)
                c = field.point[r]
                B = X[hand.contacts.body[c] - 1 - j0]
                p = wp.transform_point(B, hand.contacts.points[c])
                T = _aligned(p, wp.transform_vector(B, hand.contacts.normals[c]), point, normal, state)
        else:
            palm = palm0 + wp.min(int(wp.randf(state) * float(palms)), palms - 1)
            T = _aligned(hand.contacts.points[palm], hand.contacts.normals[palm], point, normal, state)
        rating = int(-1)
        T_object = wp.transform_inverse(T)
        if body_clear(hand, obj, 0, T_object, clearance):
            rating = 1
            if samples > 0:
                rating = rate_pose(hand, field, obj, T, palm, samples, state)
            if rating > best and rating > 0 and body_depth(hand, obj, 0, T_object, clearance) > clearance:
                rating = -1
        if rating > best:
            best = rating
            pose_out[row] = T
            palm_point_out[row] = palm
            palm_surface_out[row] = wp.where(palm >= 0, i, -1)
    rating_out[row] = best

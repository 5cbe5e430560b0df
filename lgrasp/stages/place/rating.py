"""How promising a pose of an object is: opposed contacts that fingers can reach there."""

import warp as wp

from lgrasp.field.arrays import Field, field_has
from lgrasp.grasp.collision import plane_height
from lgrasp.hand.arrays import Hand
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.structs import PlaceValues
from lgrasp.steer.arrays import may_touch

wp.set_module_options(KERNEL_OPTIONS)

_MAX_GROUP_HITS = wp.constant(6)  # rated contacts per group
_MAX_HITS = wp.constant(48)  # rated contacts of a pose
_OPPOSED_COSINE = wp.constant(0.766)  # cos 40 deg, of an inward normal to the line between two contacts
_LEAST_CONTACT_HEIGHT = wp.constant(0.005)  # [m] above the table, of contacts that rate a pose


@wp.func
def rate_pose(
    hand: Hand,
    field: Field,
    obj: Object,
    params: PlaceValues,
    groups: wp.int32,
    T: wp.transform,
    plane: wp.vec4,
    setting: wp.int32,
    palm: wp.int32,
    anchor: wp.array(dtype=wp.int32),
    state: wp.uint32,
):
    """How many pairs of reachable contacts of different groups oppose each other about the centre of mass.

    A pair counts when each contact's inward normal is within 40 degrees of the line to the other, and the line passes
    the centre of mass within ``max_com_distance``; contacts near the table ``plane`` do not. ``anchor`` holds an object
    contact point that each group can touch, or gets one. Bit g of ``groups``: group g may touch.
    """
    com = wp.transform_point(T, obj.com)
    points = wp.zeros(shape=(_MAX_HITS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(_MAX_HITS,), dtype=wp.vec3)
    owner = wp.zeros(shape=(_MAX_HITS,), dtype=wp.int32)
    m = int(0)
    R = wp.transform_get_rotation(T)
    t = wp.transform_get_translation(T)
    for g in range(hand.kin.groups):
        hits = int(0)
        if not may_touch(groups, g):
            continue
        for s in range(params.samples):
            i = anchor[g]
            if s > 0 or i < 0:
                i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
            p = wp.quat_rotate(R, obj.contact_points[i]) + t
            n = -wp.quat_rotate(R, obj.contact_normals[i])
            within = plane_height(plane, p) > _LEAST_CONTACT_HEIGHT
            if within and field_has(field, setting * hand.kin.groups + g, p, n) >= 0:
                points[m] = p
                normals[m] = n
                owner[m] = g
                m += 1
                hits += 1
                if anchor[g] < 0:
                    anchor[g] = i
                if hits == _MAX_GROUP_HITS or m == _MAX_HITS - 1:
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
                limit = _OPPOSED_COSINE * wp.length(d)
                if a > limit and b > limit:
                    u = wp.clamp(wp.dot(com - points[i], d) / wp.dot(d, d), 0.0, 1.0)
                    if wp.length(com - points[i] - d * u) < params.max_com_distance:
                        rating += 1
    return rating

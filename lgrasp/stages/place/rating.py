"""How promising a pose of an object is: opposed contacts that fingers can reach there."""

import numpy as np
import warp as wp

from lgrasp.field.arrays import Field, field_has
from lgrasp.grasp.collision import plane_height
from lgrasp.hand.arrays import Hand
from lgrasp.math.limits import MAX_GROUPS
from lgrasp.object.arrays import Object
from lgrasp.policy.arrays import Network, wide
from lgrasp.policy.score import add_count, add_distances, add_group, begin, finish, hit_channels
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.structs import PlaceValues
from lgrasp.steer.arrays import may_touch

wp.set_module_options(KERNEL_OPTIONS)

_MAX_GROUP_HITS = wp.constant(6)  # rated contacts per group
MAX_HITS = wp.constant(48)  # rated contacts of a pose
_OPPOSED_COSINE = wp.constant(0.766)  # cos 40 deg, of an inward normal to the line between two contacts
_LEAST_CONTACT_HEIGHT = wp.constant(0.005)  # [m] above the table, of contacts that rate a pose
_CHANCE_STEPS = wp.constant(2000.0)  # ratings by a policy for one unit of the logarithm of a chance
_MOST_CHANCE = wp.constant(16.0)  # logarithms beyond are as good
_LEAST_LUCK = wp.constant(1.0e-6)
_PAIRS = wp.constant(4096)  # ratings between two of a policy, told apart by opposed pairs


@wp.func
def find_reach(
    hand: Hand,
    field: Field,
    obj: Object,
    samples: wp.int32,
    groups: wp.int32,
    T: wp.transform,
    plane: wp.vec4,
    setting: wp.int32,
    anchor: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    owner: wp.array(dtype=wp.int32),
    share: wp.array(dtype=wp.float32),
    state: wp.uint32,
):
    """Contacts that fingers can reach, group by group, and how many; ``share`` of a group's points that are.

    Contacts near the table ``plane`` do not count. ``anchor`` holds an object contact point that each group can touch,
    or gets one. Bit g of ``groups``: group g may touch.
    """
    m = int(0)
    R = wp.transform_get_rotation(T)
    t = wp.transform_get_translation(T)
    for g in range(hand.kin.groups):
        hits = int(0)
        drawn = int(0)
        share[g] = 0.0
        if not may_touch(groups, g):
            continue
        for s in range(samples):
            i = anchor[g]
            if s > 0 or i < 0:
                i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
            p = wp.quat_rotate(R, obj.contact_points[i]) + t
            n = -wp.quat_rotate(R, obj.contact_normals[i])
            within = plane_height(plane, p) > _LEAST_CONTACT_HEIGHT
            drawn += 1
            if within and field_has(field, setting * hand.kin.groups + g, p, n) >= 0:
                points[m] = p
                normals[m] = n
                owner[m] = g
                m += 1
                hits += 1
                if anchor[g] < 0:
                    anchor[g] = i
                if hits == _MAX_GROUP_HITS or m == MAX_HITS - 1:
                    break
        share[g] = float(hits) / float(wp.max(drawn, 1))
    return m


@wp.func
def _opposed_pairs(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    owner: wp.array(dtype=wp.int32),
    m: wp.int32,
    com: wp.vec3,
    reach: wp.float32,
):
    """How many pairs of contacts of different groups oppose each other about the centre of mass."""
    pairs = int(0)
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
                    if wp.length(com - points[i] - d * u) < reach:
                        pairs += 1
    return pairs


@wp.func
def chance_of(
    net: Network,
    obj: Object,
    T: wp.transform,
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    share: wp.array(dtype=wp.float32),
    owner: wp.array(dtype=wp.int32),
    m: wp.int32,
    palm: wp.int32,
):
    """Log-odds of a policy that a pose gives a grasp."""
    com = wp.transform_point(T, obj.com)
    h = add_distances(net, begin(net, com, palm), obj, wp.transform_inverse(T))
    k = int(0)
    for g in range(net.groups):
        h = add_count(net, h, g, share[g])
        total = wide(0.0)
        top = wide(0.0)
        hits = int(0)
        while k < m and owner[k] == g:
            x = hit_channels(net, points[k], normals[k], com)
            total += x
            top = wp.max(top, x)
            hits += 1
            k += 1
        if hits > 0:
            h = add_group(net, h, g, total / float(hits), top)
    return finish(net, h)


@wp.func
def rate_pose(
    hand: Hand,
    field: Field,
    obj: Object,
    params: PlaceValues,
    net: Network,
    groups: wp.int32,
    T: wp.transform,
    plane: wp.vec4,
    setting: wp.int32,
    palm: wp.int32,
    anchor: wp.array(dtype=wp.int32),
    state: wp.uint32,
):
    """How many pairs of reachable contacts of different groups oppose each other about the centre of mass; where there
    is a policy, the logarithm of its chance comes first, and a random number is added.

    A pair counts when each contact's inward normal is within 40 degrees of the line to the other, and the line passes
    the centre of mass within ``max_com_distance``. Without ``samples`` a policy goes by the object's distances alone.
    The highest rating of several by a policy is drawn in proportion to a power of the chances. Arguments as of
    :func:`find_reach`.
    """
    points = wp.zeros(shape=(MAX_HITS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_HITS,), dtype=wp.vec3)
    owner = wp.zeros(shape=(MAX_HITS,), dtype=wp.int32)
    share = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.float32)
    found = find_reach(
        hand, field, obj, params.samples, groups, T, plane, setting, anchor, points, normals, owner, share, state
    )
    m = found
    if palm >= 0:
        points[m] = hand.contacts.points[palm]
        normals[m] = hand.contacts.normals[palm]
        owner[m] = -1
        m += 1
    pairs = _opposed_pairs(points, normals, owner, m, wp.transform_point(T, obj.com), params.max_com_distance)
    if net.rows.shape[0] == 0 or (pairs == 0 and params.samples > 0):
        return pairs
    luck = wp.clamp(wp.randf(wp.rand_init(wp.randi(state))), _LEAST_LUCK, 1.0 - _LEAST_LUCK)
    chance = -wp.log(1.0 + wp.exp(-chance_of(net, obj, T, points, normals, share, owner, found, palm)))
    chance -= params.policy_temperature * wp.log(-wp.log(luck))  # Gumbel's distribution
    steps = int(_CHANCE_STEPS * (wp.clamp(chance, -_MOST_CHANCE, _MOST_CHANCE) + _MOST_CHANCE))
    return steps * _PAIRS + wp.min(pairs, _PAIRS - 1)


def rated_chance(rating: np.ndarray) -> np.ndarray:
    """The chances that ratings by a policy stand for, with nothing added; 0 where there is no such rating."""
    chance = np.exp(rating // _PAIRS / float(_CHANCE_STEPS) - float(_MOST_CHANCE))
    return np.where(rating >= _PAIRS, chance, 0.0)

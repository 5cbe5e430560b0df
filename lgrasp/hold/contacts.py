"""Contacts of a hand with a free object, found afresh: spread points of each link near the object, on both surfaces."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.arrays import Hand
from lgrasp.hold.scratch import MAX_TAGS, MAX_TOUCHES, Contact, Scratch
from lgrasp.math.lanes import lanes_least, lanes_max, meet
from lgrasp.math.sdf import sdf_gradient, sdf_of, sdf_value
from lgrasp.math.transforms import tangent
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_SPREAD = wp.constant(0.15e-3)  # [m] points so much farther than the deepest belong to the same patch
_APART = wp.constant(1.5e-3)  # [m] least distance of two points of a patch
_TURN = wp.constant(0.8660254)
_DEEP = wp.constant(1.0e-3)  # [m] beneath the object's surface, deeper than links press
_NONE = wp.constant(0x7FFFFFFF)  # beyond all points


@wp.func
def _on_both(hand: Hand, obj: Object, b: wp.int32, T: wp.transform, x: wp.vec3):
    """Contact near point x of body b [body frame]: point on the object and normal in the object's frame, and the gap.

    T = T_object_body. The point and its normal are the object's, the gap is measured to the link's own surface.
    """
    p = wp.transform_point(T, x)
    s = sdf_gradient(obj.sdf, p)
    n = wp.vec3(s[0], s[1], s[2])
    gap = s[3]
    T_body = wp.transform_inverse(T)
    grid = int(-1)
    least = float(1.0e9)
    local = wp.transform_point(T_body, p - n * gap)
    for piece in range(hand.pieces.body_first[b], hand.pieces.body_first[b + 1]):
        k = hand.piece_grid[piece]
        if k >= 0 and k != grid:
            d = sdf_value(sdf_of(hand.contacts.grids, k), local)
            if d < least:
                least = d
                grid = k
    if grid >= 0 and least < 2.0e-3:
        link = sdf_of(hand.contacts.grids, grid)
        # to the nearest points of both surfaces, one after the other; the object's lies so deep that they do not meet
        for _it in range(2):
            local = wp.transform_point(T_body, p - n * (gap + _DEEP))
            m = sdf_gradient(link, local)
            p = wp.transform_point(T, local - wp.vec3(m[0], m[1], m[2]) * m[3])
            s = sdf_gradient(obj.sdf, p)
            n = wp.vec3(s[0], s[1], s[2])
            gap = s[3]
    at = p - n * gap
    return at, n, gap


@wp.func
def _reached(hand: Hand, obj: Object, w: Scratch, b: wp.int32, T: wp.transform, margin: wp.float32):
    """Points of body b that touch: the deepest within ``margin`` [m], and the farthest three of its patch, each to its
    side; -1: none. T = T_object_body."""
    deepest = int(_NONE)
    least = margin
    first = hand.cluster_first[b]
    end = hand.cluster_first[b + 1]
    for k in range(first + w.lane, end, w.lanes):
        s = hand.cluster_sphere[k]
        if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2]))) < s[3] + least:
            for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                d = sdf_value(obj.sdf, wp.transform_point(T, hand.samples[i]))
                if d < least:
                    least = d
                    deepest = i
    lowest = -lanes_max(-least)
    deepest = lanes_least(wp.where(least == lowest, deepest, _NONE))
    tags = wp.vec4i(-1, -1, -1, -1)
    if deepest < _NONE:
        tags[0] = deepest
        reach = wp.vec3(-1.0e9)
        x0 = hand.samples[deepest]
        g = sdf_gradient(obj.sdf, wp.transform_point(T, x0))
        n = wp.transform_vector(wp.transform_inverse(T), wp.vec3(g[0], g[1], g[2]))
        u = tangent(n)
        v = wp.cross(n, u)
        for k in range(first + w.lane, end, w.lanes):
            s = hand.cluster_sphere[k]
            if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2]))) < s[3] + lowest + _SPREAD:
                for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                    if sdf_value(obj.sdf, wp.transform_point(T, hand.samples[i])) < lowest + _SPREAD:
                        e = hand.samples[i] - x0
                        a = wp.dot(e, u)
                        side = wp.dot(e, v)
                        if a > reach[0]:
                            reach[0] = a
                            tags[1] = i
                        if -0.5 * a + _TURN * side > reach[1]:
                            reach[1] = -0.5 * a + _TURN * side
                            tags[2] = i
                        if -0.5 * a - _TURN * side > reach[2]:
                            reach[2] = -0.5 * a - _TURN * side
                            tags[3] = i
        for r in range(3):
            farthest = lanes_max(reach[r])
            tags[r + 1] = lanes_least(wp.where(reach[r] == farthest, tags[r + 1], _NONE))
    return tags


@wp.func
def _apart(made: wp.array(dtype=Contact), t: wp.int32, kept: wp.vec4i):
    """1 if contact t of a body is not where one of those before it that are kept is."""
    for o in range(t):
        if kept[o] == 1 and wp.length(made[o].point - made[t].point) < _APART:
            return 0
    return 1


@wp.func
def _remembered(before: wp.array(dtype=Contact), known: wp.int32, c: Contact):
    """A contact with the force of the nearest one of the same body before it."""
    nearest = float(4.0e-3)
    for o in range(known):
        if before[o].body == c.body:
            d = wp.length(before[o].point - c.point)
            if d < nearest:
                nearest = d
                c.force = before[o].force
                slip = before[o].slip
                c.slip = slip - c.normal * wp.dot(slip, c.normal)
                c.twist = before[o].twist
    return c


@wp.func
def find_contacts(hand: Hand, obj: Object, w: Scratch, T: wp.transform, margin: wp.float32, known: wp.int32):
    """Write the contacts within ``margin`` [m]; returns their number.

    Args:
        w: its ``contacts`` are the ``known`` ones of the step before, whose forces are taken over.
        T: T_base_object.
    """
    for c in range(w.lane, known, w.lanes):
        w.before[c] = w.contacts[c]
    meet()
    count = int(0)
    T_object = wp.transform_inverse(T)
    for b in range(hand.body_group.shape[0]):
        ball = hand.pieces.body_sphere[b]
        near = ball[3] >= 0.0
        X_b = wp.transform_identity()
        if b > 0:
            X_b = w.X[b - 1]
        T_b = T_object * X_b
        if near:
            near = sdf_value(obj.sdf, wp.transform_point(T_b, wp.vec3(ball[0], ball[1], ball[2]))) < ball[3] + margin
        if near:
            tags = _reached(hand, obj, w, b, T_b, margin)
            for t in range(w.lane, MAX_TAGS, w.lanes):
                if tags[t] >= 0 and (t == 0 or tags[t] != tags[0]):
                    at, normal, gap = _on_both(hand, obj, b, T_b, hand.samples[tags[t]])
                    made = Contact()
                    made.body = b
                    made.tag = tags[t]
                    made.point = wp.transform_point(T, at)
                    made.normal = wp.transform_vector(T, normal)
                    made.gap = gap
                    w.made[t] = _remembered(w.before, known, made)
            meet()
            kept = wp.vec4i(0, 0, 0, 0)
            for t in range(MAX_TAGS):
                if count < MAX_TOUCHES and tags[t] >= 0 and (t == 0 or tags[t] != tags[0]):
                    kept[t] = _apart(w.made, t, kept)
                    if kept[t] == 1:
                        if w.lane == 0:
                            w.contacts[count] = w.made[t]
                        count += 1
            meet()
    return count


@wp.func
def follow_contacts(hand: Hand, obj: Object, w: Scratch, T: wp.transform, count: wp.int32):
    """The same contacts after hand and object have moved a little: each stays with its point of the link."""
    T_object = wp.transform_inverse(T)
    for k in range(w.lane, count, w.lanes):
        b = w.contacts[k].body
        T_b = T_object
        if b > 0:
            T_b = T_object * w.X[b - 1]
        at, normal, gap = _on_both(hand, obj, b, T_b, hand.samples[w.contacts[k].tag])
        normal = wp.transform_vector(T, normal)
        w.contacts[k].point = wp.transform_point(T, at)
        w.contacts[k].normal = normal
        w.contacts[k].gap = gap
        slip = w.contacts[k].slip
        w.contacts[k].slip = slip - normal * wp.dot(slip, normal)

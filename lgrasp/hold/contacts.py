"""Contacts of a hand with a free object, found afresh: spread points of each link near the object, on both surfaces."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.arrays import Hand, hand_grid
from lgrasp.math.sdf import sdf_gradient, sdf_value
from lgrasp.math.transforms import tangent
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

MAX_TOUCHES = 40
"""Most contacts of a hand and an object."""
_SPREAD = wp.constant(0.3e-3)  # [m] points so much farther than the deepest belong to the same patch
_APART = wp.constant(1.5e-3)  # [m] least distance of two points of a patch
_TURN = wp.constant(0.8660254)


@wp.struct
class Contact:
    """Where a link meets the object."""

    body: wp.int32
    tag: wp.int32  # point of the link by which it is known from step to step
    point: wp.vec3  # base frame [m]
    normal: wp.vec3  # of the object, base frame
    gap: wp.float32  # [m]
    force: wp.float32  # along the normal, mean of the patch [N]
    slip: wp.vec3  # across the normal that friction holds against, as a spring does [m]
    twist: wp.float32  # the same about the normal [rad]


@wp.func
def _on_both(hand: Hand, obj: Object, b: wp.int32, T: wp.transform, x: wp.vec3):
    """Contact near point x of body b [body frame]: point on the object and normal in the object's frame, and the gap.

    T = T_object_body. The point and its normal are the object's, the gap is measured to the link's own surface.
    """
    p = wp.transform_point(T, x)
    s = sdf_gradient(obj.sdf, p)
    n = wp.vec3(s[0], s[1], s[2])
    gap = s[3]
    at = p - n * gap
    T_body = wp.transform_inverse(T)
    grid = int(-1)
    least = float(1.0e9)
    local = wp.transform_point(T_body, at)
    for piece in range(hand.pieces.body_first[b], hand.pieces.body_first[b + 1]):
        k = hand.piece_grid[piece]
        if k >= 0 and k != grid:
            d = sdf_value(hand_grid(hand.contacts, k), local)
            if d < least:
                least = d
                grid = k
    if grid >= 0 and least < 2.0e-3:
        link = hand_grid(hand.contacts, grid)
        # to the nearest points of both surfaces, one after the other
        for _it in range(2):
            m = sdf_gradient(link, local)
            q = wp.transform_point(T, local - wp.vec3(m[0], m[1], m[2]) * m[3])
            s = sdf_gradient(obj.sdf, q)
            n = wp.vec3(s[0], s[1], s[2])
            gap = s[3]
            at = q - n * gap
            local = wp.transform_point(T_body, at)
    return at, n, gap


@wp.func
def _keep(found: wp.array(dtype=Contact), count: wp.int32, first: wp.int32, c: Contact):
    """Add a contact unless it is where another of its body is; the number of contacts."""
    if count >= MAX_TOUCHES:
        return count
    for k in range(first, count):
        if wp.length(found[k].point - c.point) < _APART:
            return count
    found[count] = c
    return count + 1


@wp.func
def find_contacts(
    hand: Hand,
    obj: Object,
    X: wp.array(dtype=wp.transform),
    T: wp.transform,
    margin: wp.float32,
    before: wp.array(dtype=Contact),
    known: wp.int32,
    found: wp.array(dtype=Contact),
):
    """Contacts within ``margin`` [m]; returns their number.

    Args:
        X: T_base_body of bodies 1, 2, ...
        T: T_base_object.
        before: the ``known`` contacts of the step before, whose forces are taken over.
        found: written.
    """
    count = int(0)
    T_object = wp.transform_inverse(T)
    for b in range(hand.body_group.shape[0]):
        ball = hand.pieces.body_sphere[b]
        near = ball[3] >= 0.0
        X_b = wp.transform_identity()
        if b > 0:
            X_b = X[b - 1]
        T_b = T_object * X_b
        if near:
            near = sdf_value(obj.sdf, wp.transform_point(T_b, wp.vec3(ball[0], ball[1], ball[2]))) < ball[3] + margin
        if near:
            deepest = int(-1)
            least = margin
            for k in range(hand.cluster_first[b], hand.cluster_first[b + 1]):
                s = hand.cluster_sphere[k]
                if sdf_value(obj.sdf, wp.transform_point(T_b, wp.vec3(s[0], s[1], s[2]))) < s[3] + least:
                    for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                        d = sdf_value(obj.sdf, wp.transform_point(T_b, hand.samples[i]))
                        if d < least:
                            least = d
                            deepest = i
            if deepest >= 0:
                tags = wp.vec4i(deepest, -1, -1, -1)
                reach = wp.vec3(-1.0e9)
                x0 = hand.samples[deepest]
                g = sdf_gradient(obj.sdf, wp.transform_point(T_b, x0))
                n = wp.transform_vector(wp.transform_inverse(T_b), wp.vec3(g[0], g[1], g[2]))
                u = tangent(n)
                v = wp.cross(n, u)
                for k in range(hand.cluster_first[b], hand.cluster_first[b + 1]):
                    s = hand.cluster_sphere[k]
                    if sdf_value(obj.sdf, wp.transform_point(T_b, wp.vec3(s[0], s[1], s[2]))) < s[3] + least + _SPREAD:
                        for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                            if sdf_value(obj.sdf, wp.transform_point(T_b, hand.samples[i])) < least + _SPREAD:
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
                first = count
                for t in range(4):
                    if tags[t] >= 0 and (t == 0 or tags[t] != tags[0]):
                        at, normal, gap = _on_both(hand, obj, b, T_b, hand.samples[tags[t]])
                        made = Contact()
                        made.body = b
                        made.tag = tags[t]
                        made.point = wp.transform_point(T, at)
                        made.normal = wp.transform_vector(T, normal)
                        made.gap = gap
                        count = _keep(found, count, first, made)
    for k in range(count):
        # the force of the nearest contact of the same body
        nearest = float(4.0e-3)
        for o in range(known):
            if before[o].body == found[k].body:
                d = wp.length(before[o].point - found[k].point)
                if d < nearest:
                    nearest = d
                    found[k].force = before[o].force
                    slip = before[o].slip
                    found[k].slip = slip - found[k].normal * wp.dot(slip, found[k].normal)
                    found[k].twist = before[o].twist
    return count


@wp.func
def follow_contacts(
    hand: Hand,
    obj: Object,
    X: wp.array(dtype=wp.transform),
    T: wp.transform,
    found: wp.array(dtype=Contact),
    count: wp.int32,
):
    """The same contacts after hand and object have moved a little: each stays with its point of the link."""
    T_object = wp.transform_inverse(T)
    for k in range(count):
        b = found[k].body
        T_b = T_object
        if b > 0:
            T_b = T_object * X[b - 1]
        at, normal, gap = _on_both(hand, obj, b, T_b, hand.samples[found[k].tag])
        normal = wp.transform_vector(T, normal)
        found[k].point = wp.transform_point(T, at)
        found[k].normal = normal
        found[k].gap = gap
        slip = found[k].slip
        found[k].slip = slip - normal * wp.dot(slip, normal)

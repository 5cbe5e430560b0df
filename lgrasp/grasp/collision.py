"""Hand against object: a fast test for searching and an exact one for the results; object against object."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.arrays import Hand, hand_grid
from lgrasp.math.convex import point_depth
from lgrasp.math.sdf import sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_CLUSTER = wp.constant(CLUSTER_SIZE)


@wp.func
def body_clear(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, slack: wp.float32):
    """Fast test: no inner sphere of the body sinks into the object by more than ``slack`` [m]. T = T_object_body."""
    b = hand.pieces.body_sphere[body]
    if b[3] < 0.0:
        return True
    if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))) > b[3]:
        return True
    for k in range(hand.sphere_first[body], hand.sphere_first[body + 1]):
        s = hand.spheres[k]
        if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2]))) < s[3] - slack:
            return False
    return True


@wp.func
def body_apart(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, margin: wp.float32):
    """True if all surface samples of the body are farther than ``margin`` [m] from the object. T = T_object_body."""
    b = hand.pieces.body_sphere[body]
    if b[3] < 0.0:
        return True
    if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))) > b[3] + margin:
        return True
    for k in range(hand.cluster_first[body], hand.cluster_first[body + 1]):
        s = hand.cluster_sphere[k]
        if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2]))) < s[3] + margin:
            for i in range(k * _CLUSTER, (k + 1) * _CLUSTER):
                if sdf_value(obj.sdf, wp.transform_point(T, hand.samples[i])) < margin:
                    return False
    return True


@wp.func
def body_depth(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, limit: wp.float32):
    """Deepest penetration of body and object [m], 0 when apart; stops early above ``limit``. T = T_object_body.

    Both ways: surface samples of the body in the object's distance grid, obstacle points of the object in the body's
    convex pieces. Balls around runs of points skip what is far.
    """
    depth = float(0.0)
    b = hand.pieces.body_sphere[body]
    if b[3] < 0.0:
        return depth
    centre = wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))
    if sdf_value(obj.sdf, centre) > b[3]:
        return depth
    for k in range(hand.cluster_first[body], hand.cluster_first[body + 1]):
        s = hand.cluster_sphere[k]
        if sdf_value(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2]))) < s[3]:
            for i in range(k * _CLUSTER, (k + 1) * _CLUSTER):
                depth = wp.max(depth, -sdf_value(obj.sdf, wp.transform_point(T, hand.samples[i])))
            if depth > limit:
                return depth
    T_body = wp.transform_inverse(T)
    first = hand.pieces.body_first[body]
    end = hand.pieces.body_first[body + 1]
    for k in range(obj.clusters):
        s = obj.cluster_sphere[k]
        c = wp.vec3(s[0], s[1], s[2])
        d = c - centre
        reach = b[3] + s[3]
        if wp.dot(d, d) < reach * reach:
            p = wp.transform_point(T_body, c)
            for piece in range(first, end):
                grid = hand.piece_grid[piece]
                if grid >= 0 and piece > first and hand.piece_grid[piece - 1] == grid:
                    continue  # another piece of a link that is done
                if grid >= 0:
                    # a lookup in the link's distance grid is cheaper than a hull's planes, and true to its shape
                    sdf = hand_grid(hand.contacts, grid)
                    if sdf_value(sdf, p) < s[3]:
                        for i in range(k * _CLUSTER, (k + 1) * _CLUSTER):
                            depth = wp.max(depth, -sdf_value(sdf, wp.transform_point(T_body, obj.obstacles[i])))
                elif point_depth(hand.pieces, piece, p) < s[3]:
                    for i in range(k * _CLUSTER, (k + 1) * _CLUSTER):
                        q = wp.transform_point(T_body, obj.obstacles[i])
                        depth = wp.max(depth, -point_depth(hand.pieces, piece, q))
                if depth > limit:
                    return depth
    return depth


@wp.func
def _points_apart(a: Object, b: Object, T: wp.transform, margin: wp.float32):
    """True if all obstacle points of a are farther than ``margin`` [m] from b. T = T_b_a."""
    for k in range(a.clusters):
        s = a.cluster_sphere[k]
        if sdf_value(b.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2]))) < s[3] + margin:
            for i in range(k * _CLUSTER, (k + 1) * _CLUSTER):
                if sdf_value(b.sdf, wp.transform_point(T, a.obstacles[i])) < margin:
                    return False
    return True


@wp.func
def objects_apart(a: Object, b: Object, T: wp.transform, margin: wp.float32):
    """True if the surface points of either object are farther than ``margin`` [m] from the other. T = T_b_a."""
    if sdf_value(b.sdf, wp.transform_point(T, a.com)) > a.radius + margin:
        return True
    return _points_apart(a, b, T, margin) and _points_apart(b, a, wp.transform_inverse(T), margin)

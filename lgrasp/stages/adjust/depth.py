"""Where a body of the hand sinks deepest into the object."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.arrays import Hand, hand_grid
from lgrasp.math.sdf import sdf_below, sdf_gradient, sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.adjust.structs import Deepest

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def _deepest_sample(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, found: Deepest):
    """The deepest surface sample of a body, where it is deeper than what was found."""
    deeper = int(0)
    for k in range(hand.cluster_first[body], hand.cluster_first[body + 1]):
        s = hand.cluster_sphere[k]
        if sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2])), s[3] - found.depth):
            for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                p = wp.transform_point(T, hand.samples[i])
                depth = -sdf_value(obj.sdf, p)
                if depth > found.depth:
                    found.depth = depth
                    found.at = p
                    deeper = 1
    if deeper == 1:
        e = sdf_gradient(obj.sdf, found.at)
        found.away = wp.vec3(e[0], e[1], e[2])
    return found


@wp.func
def _deepest_obstacle(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, found: Deepest):
    """The obstacle point of the object that is deepest in a link that may touch, where it is deeper than that."""
    b = hand.pieces.body_sphere[body]
    centre = wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))
    T_body = wp.transform_inverse(T)
    first = hand.pieces.body_first[body]
    for k in range(obj.clusters):
        s = obj.cluster_sphere[k]
        c = wp.vec3(s[0], s[1], s[2])
        apart = c - centre
        reach = b[3] + s[3]
        if wp.dot(apart, apart) < reach * reach:
            p = wp.transform_point(T_body, c)
            for piece in range(first, hand.pieces.body_first[body + 1]):
                grid = hand.piece_grid[piece]
                if grid < 0 or (piece > first and hand.piece_grid[piece - 1] == grid):
                    continue
                sdf = hand_grid(hand.contacts, grid)
                if sdf_below(sdf, p, s[3] - found.depth):
                    for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                        x = wp.transform_point(T_body, obj.obstacles[i])
                        depth = -sdf_value(sdf, x)
                        if depth > found.depth:
                            e = sdf_gradient(sdf, x)
                            found.depth = depth
                            found.at = obj.obstacles[i]
                            found.away = -wp.transform_vector(T, wp.vec3(e[0], e[1], e[2]))
    return found


@wp.func
def deepest_point(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, least: wp.float32, both: wp.bool):
    """Where a body and the object meet deepest, of what is deeper than ``least`` [m]. T = T_object_body.

    Args:
        both: look at the object's points in the body's links as well as at the body's samples in the object.
    """
    found = Deepest()
    found.depth = least
    b = hand.pieces.body_sphere[body]
    if b[3] < 0.0 or not sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(b[0], b[1], b[2])), b[3]):
        return found
    found = _deepest_sample(hand, obj, body, T, found)
    if both:
        found = _deepest_obstacle(hand, obj, body, T, found)
    return found

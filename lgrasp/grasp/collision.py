"""Hand against object: a fast test for searching and an exact one for the results; object against object."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.hand.arrays import Hand
from lgrasp.math.convex import Pieces, point_depth
from lgrasp.math.sdf import deeper, sdf_below, sdf_far, sdf_of, sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_FAR_BELOW = wp.constant(1.0e6)  # [m]
_GPU_DEPTH_SLICES = 8


@wp.func
def body_far(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, margin: wp.float32):
    """Fastest test: the ball around the body is farther than ``margin`` [m] from the object. T = T_object_body."""
    b = hand.pieces.body_sphere[body]
    if b[3] < 0.0:
        return True
    return sdf_far(obj.sdf, wp.transform_point(T, wp.vec3(b[0], b[1], b[2])), b[3] + margin)


@wp.func
def body_clear(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, slack: wp.float32):
    """Fast test: no inner sphere of the body sinks into the object by more than ``slack`` [m]. T = T_object_body."""
    if body_far(hand, obj, body, T, 0.0):
        return True
    for k in range(hand.sphere_first[body], hand.sphere_first[body + 1]):
        s = hand.spheres[k]
        if sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2])), s[3] - slack):
            return False
    return True


@wp.func
def body_apart(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, margin: wp.float32):
    """True if all surface samples of the body are farther than ``margin`` [m] from the object. T = T_object_body."""
    if body_far(hand, obj, body, T, margin):
        return True
    for k in range(hand.cluster_first[body], hand.cluster_first[body + 1]):
        s = hand.cluster_sphere[k]
        if sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2])), s[3] + margin):
            for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                if sdf_below(obj.sdf, wp.transform_point(T, hand.samples[i]), margin):
                    return False
    return True


def depth_slices(device: str) -> int:
    """In how many slices :func:`body_depth_slice` should come: a GPU has threads for more than there are bodies."""
    return 1 if device == "cpu" else _GPU_DEPTH_SLICES


@wp.func
def obstacles_depth(
    hand: Hand,
    obj: Object,
    body: wp.int32,
    T: wp.transform,
    limit: wp.float32,
    first_run: wp.int32,
    slices: wp.int32,
):
    """Deepest obstacle point of the object in a body that has pieces [m], 0 when none is; stops early above ``limit``.
    T = T_object_body.

    Of the runs of points every ``slices``-th is looked at, from ``first_run`` on.
    """
    depth = float(0.0)
    b = hand.pieces.body_sphere[body]
    centre = wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))
    T_body = wp.transform_inverse(T)
    first = hand.pieces.body_first[body]
    end = hand.pieces.body_first[body + 1]
    for k in range(first_run, obj.clusters, slices):
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
                    sdf = sdf_of(hand.contacts.grids, grid)
                    if sdf_below(sdf, p, s[3]):
                        for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                            depth = deeper(sdf, wp.transform_point(T_body, obj.obstacles[i]), depth)
                elif point_depth(hand.pieces, piece, p) < s[3]:
                    for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                        q = wp.transform_point(T_body, obj.obstacles[i])
                        depth = wp.max(depth, -point_depth(hand.pieces, piece, q))
                if depth > limit:
                    return depth
    return depth


@wp.func
def body_depth_slice(
    hand: Hand,
    obj: Object,
    body: wp.int32,
    T: wp.transform,
    limit: wp.float32,
    first_run: wp.int32,
    slices: wp.int32,
):
    """Deepest penetration of body and object [m], 0 when apart; stops early above ``limit``. T = T_object_body.

    Both ways: surface samples of the body in the object's distance grid, obstacle points of the object in the body's
    convex pieces. Balls around runs of points skip what is far. Of these runs every ``slices``-th is looked at, from
    ``first_run`` on.
    """
    depth = float(0.0)
    b = hand.pieces.body_sphere[body]
    if b[3] < 0.0 or not sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(b[0], b[1], b[2])), b[3]):
        return depth
    for k in range(hand.cluster_first[body] + first_run, hand.cluster_first[body + 1], slices):
        s = hand.cluster_sphere[k]
        if sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2])), s[3]):
            for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                depth = deeper(obj.sdf, wp.transform_point(T, hand.samples[i]), depth)
            if depth > limit:
                return depth
    return wp.max(depth, obstacles_depth(hand, obj, body, T, limit, first_run, slices))


@wp.func
def body_depth(hand: Hand, obj: Object, body: wp.int32, T: wp.transform, limit: wp.float32):
    """:func:`body_depth_slice` of the whole."""
    return body_depth_slice(hand, obj, body, T, limit, 0, 1)


@wp.func
def plane_height(plane: wp.vec4, p: wp.vec3):
    """Height of a point above a plane [m]."""
    return plane[0] * p[0] + plane[1] * p[1] + plane[2] * p[2] - plane[3]


@wp.func
def body_height(pieces: Pieces, body: wp.int32, T: wp.transform, plane: wp.vec4, enough: wp.float32):
    """Least height of a body above a plane [m]: of its convex pieces, or less than that where it is above ``enough``.

    Args:
        T: pose of the body in the frame of the plane.
        plane: unit normal up, and height of the plane along it [m].
    """
    low = float(1.0e9)
    s = pieces.body_sphere[body]
    if s[3] < 0.0:
        return low
    centre = plane_height(plane, wp.transform_point(T, wp.vec3(s[0], s[1], s[2])))
    if centre - s[3] > enough:
        return centre - s[3]
    for piece in range(pieces.body_first[body], pieces.body_first[body + 1]):
        for k in range(pieces.vertex_first[piece], pieces.vertex_first[piece + 1]):
            height = plane_height(plane, wp.transform_point(T, pieces.vertices[k]))
            low = wp.min(low, height - pieces.radius[piece])
    return low


@wp.func
def finger_above(hand: Hand, g: wp.int32, X: wp.array(dtype=wp.transform), plane: wp.vec4, margin: wp.float32):
    """True if all bodies of a finger are above a plane by ``margin`` [m]; X holds the poses of its bodies."""
    j0 = hand.kin.joint_first[g]
    for j in range(hand.kin.joint_first[g + 1] - j0):
        if body_height(hand.pieces, 1 + j0 + j, X[j], plane, margin) < margin:
            return False
    return True


@wp.func
def resting_plane(obj: Object, T: wp.transform, pose: wp.int32):
    """Plane that an object at T rests on in one of its resting poses, as :func:`body_height` takes it, in the frame of
    T; of pose -1 one that is below everything."""
    plane = wp.vec4(0.0, 0.0, 0.0, -_FAR_BELOW)
    if pose >= 0:
        up = wp.transform_vector(T, obj.resting.up[pose])
        height = obj.resting.height[pose] + wp.dot(up, wp.transform_get_translation(T))
        plane = wp.vec4(up[0], up[1], up[2], height)
    return plane


@wp.func
def _points_apart(a: Object, b: Object, T: wp.transform, margin: wp.float32):
    """True if all obstacle points of a are farther than ``margin`` [m] from b. T = T_b_a."""
    for k in range(a.clusters):
        s = a.cluster_sphere[k]
        if sdf_below(b.sdf, wp.transform_point(T, wp.vec3(s[0], s[1], s[2])), s[3] + margin):
            for i in range(k * CLUSTER_SIZE, (k + 1) * CLUSTER_SIZE):
                if sdf_below(b.sdf, wp.transform_point(T, a.obstacles[i]), margin):
                    return False
    return True


@wp.func
def objects_apart(a: Object, b: Object, T: wp.transform, margin: wp.float32):
    """True if the surface points of either object are farther than ``margin`` [m] from the other. T = T_b_a."""
    if sdf_value(b.sdf, wp.transform_point(T, a.com)) > a.radius + margin:
        return True
    return _points_apart(a, b, T, margin) and _points_apart(b, a, wp.transform_inverse(T), margin)

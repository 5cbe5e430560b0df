"""Where a body of the hand sinks deepest into the object."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.grasp.structs import Candidates
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_forward
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.math.sdf import sdf_below, sdf_gradient, sdf_of, sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.adjust.structs import Adjusted, AdjustValues, Deepest, Progress

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def _deepest_sample(
    hand: Hand, obj: Object, body: wp.int32, T: wp.transform, part: wp.int32, parts: wp.int32, found: Deepest
):
    """The deepest surface sample of a body, where it is deeper than what was found."""
    deeper = int(0)
    for k in range(hand.cluster_first[body] + part, hand.cluster_first[body + 1], parts):
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
def _deepest_obstacle(
    hand: Hand, obj: Object, body: wp.int32, T: wp.transform, part: wp.int32, parts: wp.int32, found: Deepest
):
    """The obstacle point of the object that is deepest in a link that may touch, where it is deeper than that."""
    b = hand.pieces.body_sphere[body]
    centre = wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))
    T_body = wp.transform_inverse(T)
    first = hand.pieces.body_first[body]
    for k in range(part, obj.clusters, parts):
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
                sdf = sdf_of(hand.contacts.grids, grid)
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


@wp.kernel
def find_depths(
    hand: Hand, obj: Object, params: AdjustValues, candidates: Candidates, parts: wp.int32, sets_out: Adjusted
):
    """One thread per (set, body, slice): where a body and the object meet deepest, of what is deeper than is left.

    Args:
        parts: slices of the points of a body.
    """
    i, body, part = wp.tid()
    g = hand.body_group[body]
    if sets_out.progress[i] != int(Progress.GOING) or (g >= 0 and candidates.count[i, wp.max(g, 0)] == 0):
        return
    T = wp.transform_inverse(candidates.poses.pose[i])
    if g >= 0:
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        j0 = group_forward(hand.kin, g, candidates.q[i, g, 0], X, 0)
        T = T * X[body - 1 - j0]
    found = Deepest()
    found.depth = params.left_penetration
    b = hand.pieces.body_sphere[body]
    if b[3] >= 0.0 and sdf_below(obj.sdf, wp.transform_point(T, wp.vec3(b[0], b[1], b[2])), b[3]):
        found = _deepest_sample(hand, obj, body, T, part, parts, found)
        if sets_out.both[i] == 1:
            found = _deepest_obstacle(hand, obj, body, T, part, parts, found)
    sets_out.deepest[i, body, part] = found


@wp.func
def deepest_of(sets: Adjusted, i: wp.int32, body: wp.int32):
    """The deepest of all slices."""
    found = sets.deepest[i, body, 0]
    for part in range(1, sets.deepest.shape[2]):
        if sets.deepest[i, body, part].depth > found.depth:
            found = sets.deepest[i, body, part]
    return found

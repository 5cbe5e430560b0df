"""Correspondences of hands: planes at the object's surface and at links, and the contacts of the net wrench.

Rows are hands; everything is frozen until it is matched again (:mod:`lgrasp.refine.descent_kernels` moves the hands).
"""

import warp as wp

from lgrasp.math.lanes import lanes_before, lanes_count, lanes_least, lanes_max, lanes_sum, meet
from lgrasp.math.sdf import Grids, Sdf, sdf_far, sdf_gradient, sdf_of, sdf_value
from lgrasp.refine.volume import Volume, volume_at
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

DEEPEST, LINK_DEEPEST = 4, 2
"""Points that are kept of each link in the object, and of each ordered pair of links."""

NO_PLANE = -1.0  # [m] offset of a plane that nothing is near
_FAR_DISTANCE = 1.0e9  # [m]
_HALVINGS = 40
_NONE = wp.constant(0x7FFFFFFF)  # beyond all points

_vec_block = wp.types.vector(32, wp.float32)
_vec_deep = wp.types.vector(DEEPEST, wp.float32)
_veci_deep = wp.types.vector(DEEPEST, wp.int32)


@wp.struct
class Points:
    """Points of a hand's surface, in blocks that ride on one body (:class:`lgrasp.refine.surface.HandSurface`)."""

    body: wp.array(dtype=wp.int32)  # (L,) of each block
    points: wp.array(dtype=wp.vec3)  # (L * block,) body's frame [m]
    normals: wp.array(dtype=wp.vec3)  # (L * block,)
    weight: wp.array(dtype=wp.float32)  # (L * block,)
    palmar: wp.array(dtype=wp.int32)  # (W,) points with weight
    block: wp.int32  # points of a block


@wp.struct
class Solids:
    """Links with their distance grids, and the pairs of them that must stay apart, both ways."""

    body: wp.array(dtype=wp.int32)  # (S,)
    ball: wp.array(dtype=wp.vec4)  # (S,) body's frame [m]
    grids: Grids  # S of them
    points: wp.array2d(dtype=wp.vec3)  # (S, 32) that other links are probed with, body's frame [m]
    pairs: wp.array(dtype=wp.vec2i)  # (Q,)


@wp.struct
class Correspondences:
    """Matches of hands; a plane (n, o) has the signed distance n . x - o [m]."""

    plane: wp.array2d(dtype=wp.vec4)  # (N, P) of each point, object's frame
    pull: wp.array2d(dtype=wp.float32)  # (N, P) weight of each point, 0 where it does not pull
    block: wp.array2d(dtype=wp.vec4)  # (N, P) plane that each point is kept beyond
    distance: wp.array2d(dtype=wp.float32)  # (N, P) of each point from the object [m]
    contacts: wp.array2d(dtype=wp.int32)  # (N, contacts) points that make the net wrench
    deep: wp.array2d(dtype=wp.vec3)  # (N, S * DEEPEST) points of the object, its frame [m]
    deep_plane: wp.array2d(dtype=wp.vec4)  # (N, S * DEEPEST) of the link, body's frame
    links: wp.array(dtype=wp.int32)  # (N,) pairs of links that are near each other, the first ones of the next
    link_pair: wp.array2d(dtype=wp.int32)  # (N, Q)
    link_deep: wp.array2d(dtype=wp.vec3)  # (N, Q * LINK_DEEPEST) points of links, their bodies' frames [m]
    link_plane: wp.array2d(dtype=wp.vec4)  # (N, Q * LINK_DEEPEST) of the other link, its body's frame


@wp.func
def _plane(at: wp.vec4, x: wp.vec3):
    """Plane through the match of x."""
    return wp.vec4(at[0], at[1], at[2], at[0] * x[0] + at[1] * x[1] + at[2] * x[2] - at[3])


@wp.struct
class Surroundings:
    """What hands are drawn to and kept out of."""

    own: Volume
    around: Volume
    has_around: wp.int32


@wp.kernel
def match_points(
    points: Points,
    solids: Surroundings,
    touching: wp.int32,
    reach: wp.float32,
    soft: wp.float32,
    lanes: wp.int32,
    body: wp.array2d(dtype=wp.transform),
    m: Correspondences,
):
    """Planes, pulls and distances of points; launched over (hand, block) and lanes.

    Args:
        body: T_object_body, (N, B).
    """
    item, lane = wp.tid()
    row = item // points.body.shape[0]
    block = item % points.body.shape[0]
    T = body[row, points.body[block]]
    first = block * points.block
    apart = _vec_block()
    for k in range(lane, points.block, lanes):
        i = first + k
        x = wp.transform_point(T, points.points[i])
        at = volume_at(solids.own, x)
        m.plane[row, i] = _plane(at, x)
        m.distance[row, i] = at[3]
        apart[k // lanes] = wp.where(points.weight[i] > 0.0, wp.abs(at[3]), _FAR_DISTANCE)
        if solids.has_around == 1:
            other = volume_at(solids.around, x)
            if other[3] < at[3]:
                at = other
            m.block[row, i] = _plane(at, x)
    # the part of each link that is nearest to the object: a surface that fits nowhere else is no error
    least = float(-1.0)
    for _ in range(touching):
        following = float(_FAR_DISTANCE)
        for k in range(lane, points.block, lanes):
            if apart[k // lanes] > least:
                following = wp.min(following, apart[k // lanes])
        least = -lanes_max(-following)
    for k in range(lane, points.block, lanes):
        i = first + k
        near = apart[k // lanes]
        pull = float(0.0)
        if near <= least and near < reach:
            pull = points.weight[i] / (1.0 + near / soft)
        m.pull[row, i] = pull


@wp.kernel
def choose_contacts(
    points: Points,
    nearest: wp.int32,
    count: wp.int32,
    lanes: wp.int32,
    body: wp.array2d(dtype=wp.transform),
    m: Correspondences,
):
    """Farthest points among the ``nearest`` nearest palmar ones, the nearest first; launched over hands and lanes.

    Args:
        body: T_object_body, (N, B).
    """
    row, lane = wp.tid()
    own_best = points.palmar[0]
    own_low = float(_FAR_DISTANCE)
    own_high = float(-_FAR_DISTANCE)
    for k in range(lane, points.palmar.shape[0], lanes):
        d = m.distance[row, points.palmar[k]]
        if d < own_low:
            own_low = d
            own_best = points.palmar[k]
        own_high = wp.max(own_high, d)
    high = lanes_max(own_high)
    low = -lanes_max(-own_low)
    best = lanes_least(wp.where(own_low == low, own_best, _NONE))
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        within = float(0.0)
        for k in range(lane, points.palmar.shape[0], lanes):
            if m.distance[row, points.palmar[k]] <= middle:
                within += 1.0
        count_within = lanes_sum(within)
        if count_within >= float(nearest):
            high = middle
            if count_within == float(nearest):
                break
        else:
            low = middle
    chosen = best
    for c in range(count):
        if c > 0:
            own_farthest = float(-1.0)
            own_chosen = best
            for k in range(lane, points.palmar.shape[0], lanes):
                i = points.palmar[k]
                if m.distance[row, i] <= high:
                    x = wp.transform_point(body[row, points.body[i // points.block]], points.points[i])
                    gap = float(_FAR_DISTANCE)
                    for e in range(c):
                        o = m.contacts[row, e]
                        y = wp.transform_point(body[row, points.body[o // points.block]], points.points[o])
                        gap = wp.min(gap, wp.length_sq(x - y))
                    if gap > own_farthest:
                        own_farthest = gap
                        own_chosen = i
            farthest = lanes_max(own_farthest)
            chosen = lanes_least(wp.where(own_farthest == farthest, own_chosen, _NONE))
        if lane == 0:
            m.contacts[row, c] = chosen
        meet()


@wp.func
def _link_plane(grid: Sdf, p: wp.vec3):
    return _plane(sdf_gradient(grid, p), p)


@wp.func
def _centre(s: Solids, i: wp.int32, T: wp.transform):
    b = s.ball[i]
    return wp.transform_point(T, wp.vec3(b[0], b[1], b[2]))


@wp.kernel
def match_solids(
    s: Solids,
    cloud: wp.array(dtype=wp.vec3),
    margin: wp.float32,
    body: wp.array2d(dtype=wp.transform),
    m: Correspondences,
):
    """The deepest points of the object in each link; launched over (link, hand).

    Args:
        cloud: points of the surface of all that hands are kept out of, object frame [m], (C,).
        body: T_object_body, (N, B).
    """
    i, row = wp.tid()
    T = body[row, s.body[i]]
    back = wp.transform_inverse(T)
    centre = _centre(s, i, T)
    radius = s.ball[i][3] + margin
    grid = sdf_of(s.grids, i)
    depth = _vec_deep(_FAR_DISTANCE)
    which = _veci_deep(0)
    for k in range(cloud.shape[0]):
        if wp.length_sq(cloud[k] - centre) < radius * radius:
            x = wp.transform_point(back, cloud[k])
            if not sdf_far(grid, x, depth[DEEPEST - 1]):
                d = sdf_value(grid, x)
                at = k
                for e in range(DEEPEST):
                    if d < depth[e]:
                        later = depth[e]
                        later_at = which[e]
                        depth[e] = d
                        which[e] = at
                        d = later
                        at = later_at
    for e in range(DEEPEST):
        plane = wp.vec4(0.0, 0.0, 0.0, NO_PLANE)
        if depth[e] < _FAR_DISTANCE:
            plane = _link_plane(grid, wp.transform_point(back, cloud[which[e]]))
        m.deep[row, i * DEEPEST + e] = cloud[which[e]]
        m.deep_plane[row, i * DEEPEST + e] = plane


@wp.kernel
def match_links(
    s: Solids, margin: wp.float32, lanes: wp.int32, body: wp.array2d(dtype=wp.transform), m: Correspondences
):
    """The deepest points of the first link of each pair in the second, where they are near; over hands and lanes.

    Args:
        body: T_object_body, (N, B).
    """
    row, lane = wp.tid()
    pairs = s.pairs.shape[0]
    near = int(0)
    for start in range(0, pairs, lanes):
        pair = start + lane
        meets = int(0)
        if pair < pairs:
            a = s.pairs[pair][0]
            b = s.pairs[pair][1]
            B = body[row, s.body[b]]
            centre = _centre(s, a, body[row, s.body[a]])
            reach = s.ball[a][3] + s.ball[b][3] + margin
            if wp.length_sq(centre - _centre(s, b, B)) < reach * reach:
                inside = wp.transform_point(wp.transform_inverse(B), centre)
                if not sdf_far(sdf_of(s.grids, b), inside, s.ball[a][3] + margin):
                    meets = 1
        place = near + lanes_before(meets)
        if meets == 1:
            m.link_pair[row, place] = pair
        near += lanes_count(meets)
    meet()
    kept = int(0)
    for n in range(near):
        pair = m.link_pair[row, n]
        a = s.pairs[pair][0]
        b = s.pairs[pair][1]
        T = wp.transform_inverse(body[row, s.body[b]]) * body[row, s.body[a]]
        grid = sdf_of(s.grids, b)
        depth = wp.vec2(_FAR_DISTANCE, _FAR_DISTANCE)
        which = wp.vec2i(_NONE, _NONE)
        for k in range(lane, s.points.shape[1], lanes):
            d = sdf_value(grid, wp.transform_point(T, s.points[a, k]))
            if d < depth[0]:
                depth = wp.vec2(d, depth[0])
                which = wp.vec2i(k, which[0])
            elif d < depth[1]:
                depth[1] = d
                which[1] = k
        deepest = -lanes_max(-depth[0])
        first = lanes_least(wp.where(depth[0] == deepest, which[0], _NONE))
        if first == which[0]:
            depth[0] = depth[1]
            which[0] = which[1]
        after = -lanes_max(-depth[0])
        second = lanes_least(wp.where(depth[0] == after, which[0], _NONE))
        if deepest < margin:
            for e in range(lane, LINK_DEEPEST, lanes):
                p = s.points[a, wp.where(e == 0, first, second)]
                m.link_deep[row, kept * LINK_DEEPEST + e] = p
                m.link_plane[row, kept * LINK_DEEPEST + e] = _link_plane(grid, wp.transform_point(T, p))
            if lane == 0:
                m.link_pair[row, kept] = pair
            kept += 1
    if lane == 0:
        m.links[row] = kept

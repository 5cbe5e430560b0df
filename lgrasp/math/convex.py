"""Convex pieces (hull of vertices, inflated by a radius): true distance by GJK, depth of a point, bounding spheres."""

import warp as wp

from lgrasp.math.triangles import closest_part
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Pieces:
    """Convex pieces in body frames: piece i = hull(vertices) + ball(radius).

    Bodies are counted from 0 = static base; body 1 + j belongs to global joint j. ``body_first`` is CSR over bodies.
    """

    body_first: wp.array(dtype=wp.int32)  # (bodies + 1,)
    body_sphere: wp.array(dtype=wp.vec4)  # (bodies,) bounding sphere x, y, z, r [m]; r < 0: empty
    vertex_first: wp.array(dtype=wp.int32)  # (pieces + 1,)
    vertices: wp.array(dtype=wp.vec3)  # (vertices of all pieces,) [m]
    plane_first: wp.array(dtype=wp.int32)  # (pieces + 1,)
    planes: wp.array(dtype=wp.vec4)  # (planes of all pieces,) outward normal and offset [m]: n . x <= d
    sphere: wp.array(dtype=wp.vec4)  # (pieces,) bounding sphere [m]
    radius: wp.array(dtype=wp.float32)  # (pieces,) [m]
    body: wp.array(dtype=wp.int32)  # (pieces,)


@wp.func
def point_depth(c: Pieces, i: wp.int32, p: wp.vec3):
    """Signed distance of body-frame point p to piece i [m]: negative inside, a lower bound outside."""
    s = c.sphere[i]
    d = wp.length(p - wp.vec3(s[0], s[1], s[2])) - s[3]
    if d > 0.0:
        return d
    first = c.plane_first[i]
    end = c.plane_first[i + 1]
    r = c.radius[i]
    if first == end:
        # a ball or a capsule: one or two vertices
        a = c.vertices[c.vertex_first[i]]
        b = c.vertices[c.vertex_first[i + 1] - 1]
        ab = b - a
        t = float(0.0)
        n2 = wp.dot(ab, ab)
        if n2 > 0.0:
            t = wp.clamp(wp.dot(p - a, ab) / n2, 0.0, 1.0)
        return wp.length(p - a - ab * t) - r
    m = float(-1.0e9)
    for k in range(first, end):
        f = c.planes[k]
        m = wp.max(m, f[0] * p[0] + f[1] * p[1] + f[2] * p[2] - f[3])
    return m - r


@wp.func
def _support(c: Pieces, i: wp.int32, d: wp.vec3):
    first = c.vertex_first[i]
    best = c.vertices[first]
    m = wp.dot(best, d)
    for k in range(first + 1, c.vertex_first[i + 1]):
        v = c.vertices[k]
        x = wp.dot(v, d)
        if x > m:
            m = x
            best = v
    return best


@wp.func
def _closest_on_segment(a: wp.vec3, b: wp.vec3):
    """Closest point to the origin on a segment, as (x, y, z, mask of kept points)."""
    ab = b - a
    t = -wp.dot(a, ab)
    if t <= 0.0:
        return wp.vec4(a[0], a[1], a[2], 1.0)
    n2 = wp.dot(ab, ab)
    if t >= n2:
        return wp.vec4(b[0], b[1], b[2], 2.0)
    p = a + ab * (t / n2)
    return wp.vec4(p[0], p[1], p[2], 3.0)


@wp.func
def _face(a: wp.vec3, b: wp.vec3, c: wp.vec3, mask: wp.int32):
    """The points that a mask keeps (a 1, b 2, c 4), moved to the front, and how many they are."""
    x = a
    y = b
    n = int(0)
    if (mask & 1) != 0:
        n = 1
    if (mask & 2) != 0:
        if n == 0:
            x = b
        n += 1
    if (mask & 4) != 0:
        if n == 0:
            x = c
        elif n == 1:
            y = c
        n += 1
    return x, y, c, n


@wp.func
def pieces_clear(c: Pieces, i: wp.int32, j: wp.int32, T: wp.transform, margin: wp.float32):
    """True if pieces i and j are farther apart than margin [m]. T takes j's body frame to i's. GJK on true convex sets.

    Undecided after 24 steps counts as not clear, so the answer errs on the safe side.
    """
    si = c.sphere[i]
    sj = c.sphere[j]
    centre = wp.vec3(si[0], si[1], si[2]) - wp.transform_point(T, wp.vec3(sj[0], sj[1], sj[2]))
    gap = wp.length(centre)
    reach = c.radius[i] + c.radius[j] + margin
    if gap - si[3] - sj[3] > margin:
        return True
    R = wp.transform_get_rotation(T)
    v = centre
    if gap < 1.0e-9:
        v = wp.vec3(1.0, 0.0, 0.0)
    a = wp.vec3(0.0)
    b = wp.vec3(0.0)
    d = wp.vec3(0.0)
    e = wp.vec3(0.0)
    n = int(0)
    verdict = int(0)
    for _step in range(24):
        w = _support(c, i, -v) - wp.transform_point(T, _support(c, j, wp.quat_rotate_inv(R, v)))
        length = wp.length(v)
        low = wp.dot(v, w) / length
        if low > reach:
            verdict = 1
            break
        if n > 0 and length - low < 1.0e-6 + 1.0e-4 * length:
            # converged, and not above reach
            break
        # add w, then keep the smallest face of the simplex that holds the closest point
        if n == 0:
            a = w
            n = 1
            v = w
        elif n == 1:
            b = w
            r = _closest_on_segment(a, b)
            m = int(r[3])
            v = wp.vec3(r[0], r[1], r[2])
            if m == 2:
                a = b
            elif m == 3:
                n = 2
        elif n == 2:
            d = w
            r = closest_part(a, b, d, wp.vec3(0.0))
            m = int(r[3])
            v = wp.vec3(r[0], r[1], r[2])
            a, b, d, n = _face(a, b, d, m)
        else:
            e = w
            # the closest of the three faces that hold the new point; inside all of them: overlap
            best = float(1.0e30)
            x0 = a
            x1 = b
            x2 = d
            m = int(0)
            inside = int(1)
            for f in range(4):
                p = a
                q = b
                s = d
                o = e
                if f == 0:
                    s = e
                    o = d
                elif f == 1:
                    q = e
                    o = b
                elif f == 2:
                    p = e
                    o = a
                normal = wp.cross(q - p, s - p)
                side_o = wp.dot(normal, o - p)
                side_0 = -wp.dot(normal, p)
                if side_o * side_0 <= 0.0:
                    inside = 0
                    r = closest_part(p, q, s, wp.vec3(0.0))
                    t = wp.vec3(r[0], r[1], r[2])
                    n2 = wp.dot(t, t)
                    if n2 < best:
                        best = n2
                        v = t
                        m = int(r[3])
                        x0 = p
                        x1 = q
                        x2 = s
            if inside == 1:
                break
            a, b, d, n = _face(x0, x1, x2, m)
        if wp.length(v) < 1.0e-5:
            break
    return verdict == 1

"""Ferrari-Canny quality of a grasp."""

import math

import warp as wp

from lgrasp.math.constants import CONE_EDGES
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.qp import vec6
from lgrasp.math.transforms import tangent, vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_CONES = wp.constant(CONE_EDGES * MAX_CONTACTS)
_STEP = wp.constant(2.0 * math.pi / CONE_EDGES)  # [rad] between edges
_STARTS = wp.constant(12)
_SHOTS = wp.constant(20)
_WALKS = wp.constant(12)
_CORE = wp.constant(1.0e-4)

mat66 = wp.types.matrix((6, 6), wp.float32)


@wp.func
def _pivot(B: mat66, r: wp.int32, d: vec6):
    """Inverse of a basis after the vector with coordinates d in it has taken place r."""
    out = mat66()
    for c in range(6):
        out[r, c] = B[r, c] / d[r]
    for i in range(6):
        if i != r:
            for c in range(6):
                out[i, c] = B[i, c] - d[i] * out[r, c]
    return out


@wp.func
def _edge_wrench(arms: vec3s, cones: vec3s, e: wp.int32, scale: wp.float32):
    f = cones[e]
    t = wp.cross(arms[e // CONE_EDGES], f) * scale
    return vec6(f[0], f[1], f[2], t[0], t[1], t[2])


@wp.func
def _plane(B: mat66):
    """The plane y . w = 1 through the vectors of a basis."""
    y = B[0]
    for i in range(1, 6):
        y = y + B[i]
    return y


@wp.func
def _farthest(y: vec6, arms: vec3s, cones: vec3s, k: wp.int32, scale: wp.float32):
    """(y . w, number) of the edge wrench w that lies farthest along y."""
    yf = wp.vec3(y[0], y[1], y[2])
    yt = wp.vec3(y[3], y[4], y[5]) * scale
    top = float(-1.0e30)
    at = int(0)
    for i in range(k):
        a = yf + wp.cross(yt, arms[i])
        for e in range(CONE_EDGES):
            z = wp.dot(a, cones[i * CONE_EDGES + e])
            if z > top:
                top = z
                at = i * CONE_EDGES + e
    return top, at


@wp.func
def epsilon_bound(arms: vec3s, normals: vec3s, k: wp.int32, mu: wp.float32, radius: wp.float32, state: wp.uint32):
    """Ferrari-Canny epsilon (L1 hull of 8-edge cones with unit normal force, torque / radius), from above; >= 0.

    epsilon is the distance of the hull's nearest facet. From each start a ray is shot at the hull (simplex method; a
    tiny cross-polytope of size 1e-4 is the first basis), then a walk crosses from facet to nearer facet (dual simplex
    pivots) until the foot of the perpendicular lies in the facet. Every facet passed is an upper bound. Values below
    2.5e-4, the resolution, are returned as 0.
    """
    cones = wp.zeros(shape=(_CONES,), dtype=wp.vec3)
    for i in range(k):
        n = normals[i]
        t = tangent(n)
        b = wp.cross(n, t)
        for e in range(CONE_EDGES):
            angle = _STEP * float(e)
            cones[i * CONE_EDGES + e] = n + (t * wp.cos(angle) + b * wp.sin(angle)) * mu
    scale = 1.0 / radius
    least = float(1.0e30)
    for _s in range(_STARTS):
        v = vec6()  # the ray
        for c in range(6):
            v[c] = wp.randn(state)
        v = wp.normalize(v)
        # B: inverse of the basis (its vectors as columns); x: coordinates of v, all >= 0; y: plane through the basis
        B = mat66()
        x = vec6()
        y = vec6()
        for c in range(6):
            B[c, c] = wp.where(v[c] >= 0.0, 1.0, -1.0) / _CORE
            x[c] = wp.abs(v[c]) / _CORE
            y[c] = B[c, c]
        ok = int(0)
        for _t in range(_SHOTS):
            # the wrench farthest beyond the plane y . w = 1 enters
            top, at = _farthest(y, arms, cones, k, scale)
            least = wp.min(least, top / wp.length(y))
            if least < 2.5e-4:
                return 0.0
            if top < 1.0 + 1.0e-4:
                ok = 1
                break
            d = B * _edge_wrench(arms, cones, at, scale)
            r = int(-1)
            low = float(1.0e30)
            for c in range(6):
                if d[c] > 1.0e-5 and x[c] < low * d[c]:
                    low = x[c] / d[c]
                    r = c
            if r < 0:
                break
            B = _pivot(B, r, d)
            for c in range(6):
                x[c] = wp.max(x[c] - low * d[c], 0.0)
            x[r] = low
            y = _plane(B)
        if ok == 0:
            continue
        for _t in range(_WALKS):
            # the perpendicular's coordinates: all >= 0 where its foot is in the facet
            x = B * y
            r = int(0)
            for c in range(1, 6):
                if x[c] < x[r]:
                    r = c
            if x[r] > -1.0e-4 * wp.length(x):
                break
            # turn the plane about the ridge opposite vertex r until it meets the next wrench
            row = B[r]
            yf = wp.vec3(y[0], y[1], y[2])
            yt = wp.vec3(y[3], y[4], y[5]) * scale
            rf = wp.vec3(row[0], row[1], row[2])
            rt = wp.vec3(row[3], row[4], row[5]) * scale
            theta = float(1.0e30)
            at = int(-1)
            for i in range(k):
                a = yf + wp.cross(yt, arms[i])
                b = rf + wp.cross(rt, arms[i])
                for e in range(CONE_EDGES):
                    f = cones[i * CONE_EDGES + e]
                    slope = -wp.dot(b, f)
                    if slope > 1.0e-4:
                        room = wp.max(1.0 - wp.dot(a, f), 0.0)
                        if room < theta * slope:
                            theta = room / slope
                            at = i * CONE_EDGES + e
            if at < 0:
                break
            B = _pivot(B, r, B * _edge_wrench(arms, cones, at, scale))
            y = _plane(B)
            # rounding may leave wrenches beyond the plane: the bound is their support, not the plane
            top, at = _farthest(y, arms, cones, k, scale)
            least = wp.min(least, top / wp.length(y))
    if least < 2.5e-4:
        return 0.0
    return least

"""FSWO (eq. 1): the point of least norm in the convex hull of the frictionless wrenches of a few contacts."""

import warp as wp

from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.transforms import vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.unrolled import unrolled

wp.set_module_options(KERNEL_OPTIONS)

mat63 = wp.types.matrix((MAX_CONTACTS, 3), wp.float32)
mat_gram = wp.types.matrix((MAX_CONTACTS, MAX_CONTACTS), wp.float32)
vec_share = wp.types.vector(MAX_CONTACTS, wp.float32)
_FEW = 4  # contacts whose systems stay in registers
mat_few = wp.types.matrix((_FEW, _FEW), wp.float32)
mat_few3 = wp.types.matrix((_FEW, 3), wp.float32)
vec_few = wp.types.vector(_FEW, wp.float32)


@wp.func
def centroid(points: vec3s, k: wp.int32):
    """Mean of the first k points."""
    c = wp.vec3(0.0)
    for i in range(k):
        c = c + points[i]
    return c / float(k)


@unrolled
@wp.func
def _frictionless_few(points: vec3s, normals: vec3s, k: wp.int32, torque_scale: wp.float32):
    """:func:`frictionless` of at most _FEW contacts: the same with loops of known length."""
    middle = centroid(points, k)
    N = mat_few3()
    W = mat_few3()
    G = mat_few()
    active = vec_few()
    trace = float(0.0)
    for i in range(wp.static(_FEW)):
        if wp.static(i) < k:
            active[i] = 1.0
            N[i] = normals[i]
            W[i] = wp.cross(points[i] - middle, normals[i]) * torque_scale
        for j in range(wp.static(i + 1)):
            G[i, wp.static(j)] = wp.dot(N[i], N[j]) + wp.dot(W[i], W[j])
        trace += G[i, i]
    eps = 1.0e-6 * trace / float(k)
    least = float(0.0)
    value = float(0.0)
    for _drop in range(k):
        # L D L^T of the active block; inactive rows are identity
        L = mat_few()
        M = mat_few()  # L D
        inverse = vec_few()  # of D
        z = vec_few()
        for i in range(wp.static(_FEW)):
            d = active[i] * G[i, i] + wp.where(active[i] > 0.0, eps, 1.0)
            y = active[wp.static(i)]
            for j in range(i):
                s = active[i] * active[j] * G[i, j]
                for c in range(j):
                    s -= M[i, wp.static(c)] * L[j, c]
                M[i, wp.static(j)] = s
                L[i, j] = s * inverse[j]
                d -= s * L[i, j]
                y -= L[i, j] * z[j]
            inverse[i] = 1.0 / wp.max(d, eps * 0.01)
            z[i] = y
        total = float(0.0)
        low = float(1.0e30)
        drop = int(0)
        for b in range(wp.static(_FEW)):
            i = wp.static(_FEW - 1 - b)
            s = z[i] * inverse[i]
            for c in range(wp.static(_FEW - b), wp.static(_FEW)):
                s -= L[wp.static(c), i] * z[c]
            z[i] = s
            if active[i] > 0.0:
                total += s
                if s < low:
                    low = s
                    drop = i
        value = 1.0 / wp.max(total, 1.0e-12)
        if low >= 0.0:
            if _drop == 0:
                least = low * value
            break
        for i in range(wp.static(_FEW)):
            active[i] = wp.where(wp.static(i) == drop, 0.0, active[i])
    return wp.vec2(wp.sqrt(wp.max(value - eps, 0.0)), least)


@wp.func
def frictionless(points: vec3s, normals: vec3s, k: wp.int32, torque_scale: wp.float32):
    """FSWO (eq. 1) by active sets on the k x k Gram matrix, for the inner loop of the search.

    The full-support solution is exact when all its shares are positive. Otherwise the smallest share is dropped and the
    rest solved again, which gives a feasible point, so an upper bound: good enough to steer, and never accepted since a
    contact without force is not.

    Returns:
        (least norm, smallest share of the normal force; 0 when a contact was dropped).
    """
    if k <= _FEW:
        return _frictionless_few(points, normals, k, torque_scale)
    middle = centroid(points, k)
    G = mat_gram()
    W = mat63()
    trace = float(0.0)
    for i in range(k):
        t = wp.cross(points[i] - middle, normals[i]) * torque_scale
        W[i] = t
        for j in range(i + 1):
            g = wp.dot(normals[i], normals[j]) + wp.dot(t, W[j])
            G[i, j] = g
            G[j, i] = g
        trace += G[i, i]
    eps = 1.0e-6 * trace / float(k)
    active = vec_share()
    for i in range(k):
        active[i] = 1.0
    least = float(0.0)
    value = float(0.0)
    for _drop in range(k):
        # Cholesky of the active block; inactive rows are identity
        L = mat_gram()
        z = vec_share()
        for i in range(k):
            if active[i] > 0.0:
                for j in range(i + 1):
                    if active[j] > 0.0:
                        s = G[i, j]
                        for c in range(j):
                            s -= L[i, c] * L[j, c]
                        if i == j:
                            L[i, i] = wp.sqrt(wp.max(s + eps, eps * 0.01))
                        else:
                            L[i, j] = s / L[j, j]
                s = float(1.0)
                for c in range(i):
                    s -= L[i, c] * z[c]
                z[i] = s / L[i, i]
        total = float(0.0)
        low = float(1.0e30)
        drop = int(0)
        for b in range(k):
            i = k - 1 - b
            if active[i] > 0.0:
                s = z[i]
                for c in range(i + 1, k):
                    if active[c] > 0.0:
                        s -= L[c, i] * z[c]
                z[i] = s / L[i, i]
                total += z[i]
                if z[i] < low:
                    low = z[i]
                    drop = i
        value = 1.0 / wp.max(total, 1.0e-12)
        if low >= 0.0:
            if _drop == 0:
                least = low * value
            break
        active[drop] = 0.0
    return wp.vec2(wp.sqrt(wp.max(value - eps, 0.0)), least)

"""Exact small QPs: the point of least norm in the convex hull of contact wrenches (Wolfe's algorithm in 6-D).

GSWO (eq. 2) is this problem over friction cones, and so is the resistance to an outside force
(:mod:`lgrasp.math.loads`), of a hull moved by that force.
"""

import warp as wp

from lgrasp.math.cholesky import solving
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.transforms import tangent, vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_MAX_CORRAL = 8
_EXACT = wp.constant(1.0e-4)  # relative error of squared norms
NO_LIMIT = wp.constant(1.0e15)
"""Norm that no wrench reaches."""

vec6 = wp.types.vector(6, wp.float32)
vec8 = wp.types.vector(_MAX_CORRAL, wp.float32)
mat8 = wp.types.matrix((_MAX_CORRAL, _MAX_CORRAL), wp.float32)
mat86 = wp.types.matrix((_MAX_CORRAL, 6), wp.float32)
mat83 = wp.types.matrix((_MAX_CORRAL, 3), wp.float32)


@wp.func
def wrench(r: wp.vec3, f: wp.vec3, torque_scale: wp.float32):
    """(force, torque_scale * r x f) of force f acting at arm r [m]."""
    t = wp.cross(r, f) * torque_scale
    return vec6(f[0], f[1], f[2], t[0], t[1], t[2])


@wp.func
def _best_direction(a: wp.vec3, n: wp.vec3, mu: wp.float32, edges: wp.int32):
    """Force with unit normal part inside the friction cone that minimises a . f; edges = 0: the round cone."""
    if mu <= 0.0:
        return n
    if edges == 0:
        across = a - n * wp.dot(a, n)
        across = across - n * wp.dot(across, n)  # of what rounding leaves along n where little is across
        s = wp.length(across)
        if s < 1.0e-12:
            return n
        return n - across * (mu / s)
    t = tangent(n)
    b = wp.cross(n, t)
    step = 6.2831853 / float(edges)
    angle = wp.round(wp.atan2(-wp.dot(a, b), -wp.dot(a, t)) / step) * step
    return n + (t * wp.cos(angle) + b * wp.sin(angle)) * mu


solve_spd = solving(_MAX_CORRAL)


@wp.func
def _affine_weights(G: mat8, m: wp.int32):
    """Weights (sum 1) of the least-norm point of the affine hull of m points, Gram matrix G, regularised."""
    trace = float(0.0)
    for i in range(m):
        trace += G[i, i]
    eps = 1.0e-6 * trace / float(m) + 1.0e-12
    z = solve_spd(G, vec8(1.0), m, eps, eps * 0.01)
    total = float(0.0)
    for r in range(m):
        total += z[m - 1 - r]
    return z / total


@wp.struct
class Program:
    """Conditions on the forces of a grasp."""

    friction: wp.float32
    edges: wp.int32  # of each friction pyramid, 0 for round cones
    torque_scale: wp.float32  # weight of torque against force [1/m]
    load: vec6  # that the forces meet
    total: wp.float32  # normal forces of all contacts together
    less: wp.int32  # 1: fewer may do
    stop: wp.float32  # the norm below which any answer does
    limit: wp.float32  # the norm above which any answer does
    exact: wp.float32  # relative error of the squared norm


@wp.func
def least_norm(arms: vec3s, normals: vec3s, k: wp.int32, p: Program, forces: vec3s):
    """Point of least norm of ``p.load`` plus wrenches with f_i in the friction cone of n_i, by Wolfe's algorithm.

    Args:
        forces: (local, MAX_CONTACTS) receives the optimal forces.
    """
    P = mat86()
    F = mat83()
    owner = vec8()
    w = vec8()
    G = mat8()
    # start at no force at all, or at the first contact's normal wrench
    x = p.load
    m = int(1)
    owner[0] = -1.0
    if p.less == 0:
        x = p.load + wrench(arms[0], normals[0] * p.total, p.torque_scale)
        F[0] = normals[0] * p.total
        owner[0] = 0.0
    P[0] = x
    w[0] = 1.0
    G[0, 0] = wp.dot(x, x)
    norm2 = G[0, 0]
    for _major in range(32):
        if norm2 <= p.stop * p.stop:
            break
        # the hull point that goes farthest towards the origin: a linear problem over the cones
        xf = wp.vec3(x[0], x[1], x[2])
        xt = wp.vec3(x[3], x[4], x[5]) * p.torque_scale
        best = float(1.0e30)
        bi = int(-1)
        bf = wp.vec3(0.0)
        if p.less == 1:
            best = 0.0
        for i in range(k):
            a = xf + wp.cross(xt, arms[i])
            f = _best_direction(a, normals[i], p.friction, p.edges)
            s = wp.dot(a, f)
            if s < best:
                best = s
                bi = i
                bf = f
        best = best * p.total + wp.dot(x, p.load)
        if best > norm2 - 1.0e-6 - p.exact * norm2 or m >= _MAX_CORRAL:
            break
        if best > 0.0 and best * best > p.limit * p.limit * norm2:
            break
        y = p.load
        if bi >= 0:
            bf = bf * p.total
            y = p.load + wrench(arms[bi], bf, p.torque_scale)
        P[m] = y
        F[m] = bf
        owner[m] = float(bi)
        w[m] = 0.0
        for j in range(m + 1):
            G[m, j] = wp.dot(P[m], P[j])
            G[j, m] = G[m, j]
        m += 1
        # inner loop: least-norm point of the affine hull; leave it at the boundary of the simplex, drop, repeat
        for _minor in range(_MAX_CORRAL):
            z = _affine_weights(G, m)
            low = float(1.0)
            for j in range(m):
                low = wp.min(low, z[j])
            if low > 1.0e-7:
                for j in range(m):
                    w[j] = z[j]
                break
            theta = float(1.0)
            drop = int(-1)
            for j in range(m):
                if z[j] <= 1.0e-7:
                    t = w[j] / wp.max(w[j] - z[j], 1.0e-12)
                    if t < theta or drop < 0:
                        theta = wp.min(theta, t)
                        drop = j
            for j in range(m):
                w[j] = w[j] + theta * (z[j] - w[j])
            # remove `drop`: move the last point into its place
            m -= 1
            if drop != m:
                w[drop] = w[m]
                owner[drop] = owner[m]
                P[drop] = P[m]
                F[drop] = F[m]
                for j in range(m):
                    G[drop, j] = G[m, j]
                    G[j, drop] = G[j, m]
                G[drop, drop] = G[m, m]
            if m <= 1:
                w[0] = 1.0
                break
        share = float(0.0)
        for j in range(m):
            w[j] = wp.max(w[j], 0.0)
            share += w[j]
        for c in range(6):
            s = float(0.0)
            for j in range(m):
                s += w[j] * P[j, c]
            x[c] = s / share
        last = norm2
        norm2 = wp.dot(x, x)
        if norm2 > last * 0.99999:
            break
    for i in range(k):
        forces[i] = wp.vec3(0.0)
    share = float(0.0)
    for j in range(m):
        share += w[j]
    for j in range(m):
        i = int(owner[j])
        if i >= 0:
            forces[i] = forces[i] + F[j] * (w[j] / share)
    return wp.sqrt(norm2)


@wp.func
def _balancing(mu: wp.float32, torque_scale: wp.float32):
    """What forces in round cones must do to balance each other, without a norm at which to stop."""
    p = Program()
    p.friction = mu
    p.torque_scale = torque_scale
    p.total = 1.0
    p.exact = _EXACT
    return p


@wp.func
def balance(
    arms: vec3s,
    normals: vec3s,
    k: wp.int32,
    mu: wp.float32,
    edges: wp.int32,
    torque_scale: wp.float32,
    stop: wp.float32,
    limit: wp.float32,
    least: wp.float32,
    forces: vec3s,
):
    """min |sum_i (f_i, torque_scale * arm_i x f_i)| with f_i in the friction cone of n_i and sum_i f_i . n_i = 1.

    Args:
        arms, normals: local arrays; contact i acts at ``arms[i]`` [m] along unit inward normal ``normals[i]``.
        k: number of contacts. mu: friction coefficient. edges: cone edges, 0 for the round cone.
        stop: return as soon as the norm is below this.
        limit: return as soon as it is known to be above this (NO_LIMIT: find it).
        least: force along its normal that every contact bears, below 1 / k; the cones are of what comes on top.
        forces: (local, MAX_CONTACTS) receives the optimal forces.

    Returns:
        The least norm, or one above ``limit``.
    """
    p = _balancing(mu, torque_scale)
    p.edges = edges
    p.stop = stop
    p.limit = limit
    p.total = 1.0 - least * float(k)
    for i in range(k):
        p.load += wrench(arms[i], normals[i] * least, torque_scale)
    norm = least_norm(arms, normals, k, p, forces)
    for i in range(k):
        forces[i] = forces[i] + normals[i] * least
    return norm


@wp.func
def balances(arms: vec3s, normals: vec3s, k: wp.int32, mu: wp.float32, torque_scale: wp.float32, limit: wp.float32):
    """True if :func:`balance` with round cones is ``limit`` at most, as soon as that is known."""
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    p = _balancing(mu, torque_scale)
    p.stop = limit
    p.limit = limit
    return least_norm(arms, normals, k, p, forces) <= limit

"""Exact small QPs: the point of least norm in the convex hull of contact wrenches (Wolfe's algorithm in 6-D).

Both published scores are this problem: FSWO (eq. 1) over the k frictionless wrenches, GSWO (eq. 2) over friction
cones. So is the resistance to an outside force, of a hull moved by that force.
"""

import warp as wp

from lgrasp.math.cholesky import solving
from lgrasp.math.constants import LOAD_ARM, LOAD_FORCE
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.transforms import tangent, vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.unrolled import unrolled

wp.set_module_options(KERNEL_OPTIONS)

_MAX_CORRAL = 8
_LOAD_SCALE = wp.constant(1.0 / LOAD_ARM)  # [1/m]
_EXACT, _LOAD_EXACT = wp.constant(1.0e-4), wp.constant(1.0e-3)  # relative errors of squared norms
_NO_LIMIT = wp.constant(1.0e15)

vec6 = wp.types.vector(6, wp.float32)
vec8 = wp.types.vector(_MAX_CORRAL, wp.float32)
mat8 = wp.types.matrix((_MAX_CORRAL, _MAX_CORRAL), wp.float32)
mat86 = wp.types.matrix((_MAX_CORRAL, 6), wp.float32)
mat83 = wp.types.matrix((_MAX_CORRAL, 3), wp.float32)
mat63 = wp.types.matrix((MAX_CONTACTS, 3), wp.float32)
mat_gram = wp.types.matrix((MAX_CONTACTS, MAX_CONTACTS), wp.float32)
_FEW = 4  # contacts whose systems stay in registers
mat_few = wp.types.matrix((_FEW, _FEW), wp.float32)
mat_few3 = wp.types.matrix((_FEW, 3), wp.float32)
vec_few = wp.types.vector(_FEW, wp.float32)
vec_share = wp.types.vector(MAX_CONTACTS, wp.float32)


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
def _least_norm(arms: vec3s, normals: vec3s, k: wp.int32, p: Program, forces: vec3s):
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
    forces: vec3s,
):
    """min |sum_i (f_i, torque_scale * arm_i x f_i)| with f_i in the friction cone of n_i and sum_i f_i . n_i = 1.

    Args:
        arms, normals: local arrays; contact i acts at ``arms[i]`` [m] along unit inward normal ``normals[i]``.
        k: number of contacts. mu: friction coefficient. edges: cone edges, 0 for the round cone.
        stop: return as soon as the norm is below this.
        forces: (local, MAX_CONTACTS) receives the optimal forces.

    Returns:
        The least norm.
    """
    p = _balancing(mu, torque_scale)
    p.edges = edges
    p.stop = stop
    p.limit = _NO_LIMIT
    return _least_norm(arms, normals, k, p, forces)


@wp.func
def balances(arms: vec3s, normals: vec3s, k: wp.int32, mu: wp.float32, torque_scale: wp.float32, limit: wp.float32):
    """True if :func:`balance` with round cones is ``limit`` at most, as soon as that is known."""
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    p = _balancing(mu, torque_scale)
    p.stop = limit
    p.limit = limit
    return _least_norm(arms, normals, k, p, forces) <= limit


@wp.func
def _pull(turn: wp.quat, direction: wp.int32):
    """Unit force along one of x, y, z, -x, -y, -z of the hand's base frame, turned by ``turn``."""
    e = wp.vec3(0.0)
    e[direction % 3] = wp.where(direction < 3, 1.0, -1.0)
    return wp.quat_rotate(turn, e)


@wp.func
def unresisted(
    arms: vec3s,
    normals: vec3s,
    k: wp.int32,
    mu: wp.float32,
    turn: wp.quat,
    direction: wp.int32,
    stop: wp.float32,
    limit: wp.float32,
):
    """How much of a unit force e on the centre of mass stays unresisted, 0 to 1.

    min |e + sum_i (f_i, arm_i x f_i / LOAD_ARM)| with f_i in the round friction cone of n_i and
    sum_i f_i . n_i <= LOAD_FORCE: what cannot be held with so many times the load is not held.

    Args:
        arms: from the centre of mass [m]. normals: inward.
        turn: from the hand's base frame to that of arms and normals.
        direction: of e in the hand's base frame: x, y, z, -x, -y, -z.
        stop, limit: return as soon as the answer is known to be below, above this.
    """
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    e = _pull(turn, direction)
    p = Program()
    p.friction = mu
    p.torque_scale = _LOAD_SCALE
    p.load = vec6(e[0], e[1], e[2], 0.0, 0.0, 0.0)
    p.total = LOAD_FORCE
    p.less = 1
    p.stop = stop
    p.limit = limit
    p.exact = _LOAD_EXACT
    return _least_norm(arms, normals, k, p, forces)


@wp.func
def by_difficulty(normals: vec3s, k: wp.int32, mu: wp.float32, turn: wp.quat, rank: wp.int32):
    """The direction of :func:`unresisted` that is ``rank``-th (0: first) of the six in what contacts lack along it.

    What they lack is a bound from forces alone, so that loads which nothing resists come first.
    """
    lack = vec6()
    for axis in range(3):
        e = _pull(turn, axis)
        for i in range(k):
            along = wp.dot(e, normals[i])
            across = mu * wp.sqrt(wp.max(1.0 - along * along, 0.0))
            lack[axis] = wp.min(lack[axis], along - across)
            lack[axis + 3] = wp.min(lack[axis + 3], -along - across)
    found = int(0)
    for a in range(6):
        before = int(0)
        for b in range(6):
            if lack[b] > lack[a] or (lack[b] == lack[a] and b < a):
                before += 1
        if before == rank:
            found = a
    return found


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

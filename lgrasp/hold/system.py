"""The linear system of a Newton step: fingers couple through the object and through the joints that they share only,
so each finger's own joints are eliminated by themselves, then the shared ones.

Flat arrays: A (dofs, MAX_DOFS) lower triangles of the fingers' blocks, then their Cholesky factors; B (dofs, 7) the
blocks between a finger and the object, and the gradient. The rows after those of the fingers are the shared joints'; a
finger's block has a copy of each that moves it, after its own joints. C (6, 6) and g (6) are the object's.
"""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hold.contacts import Contact
from lgrasp.hold.energy import Material, friction_stiffness, twist_stiffness
from lgrasp.math.limits import MAX_DOFS
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_LEAST = wp.constant(1.0e-9)  # of a pivot


@wp.func
def add_contact(
    hand: Hand,
    m: Material,
    contact: Contact,
    c: wp.int32,
    y: wp.vec4,
    com: wp.vec3,
    column: wp.array(dtype=wp.vec3),
    spin: wp.array(dtype=wp.float32),
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.float32),
    C: wp.spatial_matrix,
    g: wp.spatial_vector,
):
    """Add slope and curvature of contact c at its motion y; returns C and g."""
    n = contact.normal
    s = wp.vec3(y[0], y[1], y[2])
    yn = wp.dot(n, s)
    deep = wp.max(-(contact.gap + yn), 0.0)
    limit = m.friction * contact.force
    if deep == 0.0 and limit == 0.0:
        return C, g
    f = n * (-m.contact * deep)
    H = wp.mat33(0.0)
    if deep > 0.0:
        H = wp.outer(n, n) * m.contact
    if limit > 0.0:
        slip = s - n * yn + contact.slip
        far = wp.length(slip)
        k = friction_stiffness(far, m.contact, limit)
        f = f + slip * k
        H = H + (wp.identity(n=3, dtype=wp.float32) - wp.outer(n, n)) * k
        if k < m.contact:
            H = H - wp.outer(slip, slip) * (k / (far * far))
    turn = float(0.0)
    turn_k = float(0.0)
    if m.torsion > 0.0:
        twist = y[3] + contact.twist
        k = friction_stiffness(wp.abs(twist), twist_stiffness(m), m.torsion * contact.force)
        turn = k * twist
        if k == twist_stiffness(m):
            turn_k = k
    r = contact.point - com
    R = wp.skew(r)
    RH = R * H
    K = RH * wp.transpose(R)
    rf = wp.cross(r, f)
    for a in range(3):
        g[a] = g[a] - f[a]
        g[3 + a] = g[3 + a] - rf[a] - n[a] * turn
        for b in range(3):
            C[a, b] += H[a, b]
            C[3 + a, b] += RH[a, b]
            C[b, 3 + a] += RH[a, b]
            C[3 + a, 3 + b] += K[a, b] + turn_k * n[a] * n[b]
    if contact.body > 0:
        group = hand.body_group[contact.body]
        first = hand.kin.dof_first[group]
        for d in range(hand.kin.dof_first[group + 1] - first):
            j = column[c * MAX_DOFS + d]
            t = spin[c * MAX_DOFS + d]
            h = H * j
            rh = wp.cross(r, h)
            at = (first + d) * 7
            B[at + 6] += wp.dot(j, f) + t * turn
            for a in range(3):
                B[at + a] -= h[a]
                B[at + 3 + a] -= rh[a] + turn_k * t * n[a]
            for e in range(d + 1):
                A[(first + d) * MAX_DOFS + e] += (
                    wp.dot(column[c * MAX_DOFS + e], h) + turn_k * t * spin[c * MAX_DOFS + e]
                )
    return C, g


@wp.func
def clear_rows(first: wp.int32, end: wp.int32, A: wp.array(dtype=wp.float32), B: wp.array(dtype=wp.float32)):
    """Set some rows of A and B to zero."""
    for k in range(first, end):
        for e in range(MAX_DOFS):
            A[k * MAX_DOFS + e] = 0.0
        for e in range(7):
            B[k * 7 + e] = 0.0


@wp.func
def eliminate_finger(
    first: wp.int32,
    free: wp.int32,
    dofs: wp.int32,
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.float32),
    C: wp.spatial_matrix,
    g: wp.spatial_vector,
):
    """Factor the ``free`` first rows of a block of ``dofs`` and take their part out of the others, which remain, and
    out of the object's; returns C (lower triangle) and g."""
    for d in range(dofs):
        k = first + d
        for e in range(d + 1):
            s = A[k * MAX_DOFS + e]
            for o in range(wp.min(e, free)):
                s -= A[k * MAX_DOFS + o] * A[(first + e) * MAX_DOFS + o]
            if e == d and e < free:
                s = wp.sqrt(wp.max(s, _LEAST))
            elif e < free:
                s = s / A[(first + e) * MAX_DOFS + e]
            A[k * MAX_DOFS + e] = s
        for col in range(7):
            s = B[k * 7 + col]
            for o in range(wp.min(d, free)):
                s -= A[k * MAX_DOFS + o] * B[(first + o) * 7 + col]
            if d < free:
                s = s / A[k * MAX_DOFS + d]
            B[k * 7 + col] = s
        if d < free:
            for a in range(6):
                g[a] = g[a] - B[k * 7 + a] * B[k * 7 + 6]
                for b in range(a + 1):
                    C[a, b] -= B[k * 7 + a] * B[k * 7 + b]
    return C, g


@wp.func
def gather_shared(
    hand: Hand,
    group: wp.int32,
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.float32),
    step: wp.array(dtype=wp.float32),
):
    """Add what remains of a finger, and its gradient in ``step``, to the rows of the shared joints."""
    first = hand.kin.dof_first[group]
    end = hand.kin.dof_first[hand.kin.groups]
    for k in range(first + hand.kin.dof_free[group], hand.kin.dof_first[group + 1]):
        at = end + hand.kin.dof_shared[k]
        step[at] += step[k]
        for col in range(7):
            B[at * 7 + col] += B[k * 7 + col]
        for o in range(first + hand.kin.dof_free[group], k + 1):
            other = hand.kin.dof_shared[o]
            value = A[k * MAX_DOFS + o - first]
            if other <= at - end:
                A[at * MAX_DOFS + other] += value
            else:
                A[(end + other) * MAX_DOFS + at - end] += value


@wp.func
def give_shared(hand: Hand, group: wp.int32, step: wp.array(dtype=wp.float32)):
    """Copy the steps of the shared joints to those of a finger."""
    for k in range(hand.kin.dof_first[group] + hand.kin.dof_free[group], hand.kin.dof_first[group + 1]):
        step[k] = step[hand.kin.dof_first[hand.kin.groups] + hand.kin.dof_shared[k]]


@wp.func
def solve_object(C: wp.spatial_matrix, g: wp.spatial_vector):
    """x of C x = -g by Cholesky; the lower triangle of C counts."""
    x = wp.spatial_vector()
    for a in range(6):
        for b in range(a + 1):
            s = C[a, b]
            for o in range(b):
                s -= C[a, o] * C[b, o]
            if a == b:
                C[a, a] = wp.sqrt(wp.max(s, _LEAST))
            else:
                C[a, b] = s / C[b, b]
        s = -g[a]
        for o in range(a):
            s -= C[a, o] * x[o]
        x[a] = s / C[a, a]
    for back in range(6):
        a = 5 - back
        s = x[a]
        for o in range(a + 1, 6):
            s -= C[o, a] * x[o]
        x[a] = s / C[a, a]
    return x


@wp.func
def solve_finger(
    first: wp.int32,
    free: wp.int32,
    dofs: wp.int32,
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.float32),
    x: wp.spatial_vector,
    step: wp.array(dtype=wp.float32),
):
    """Replace the gradient in ``step`` by the step of the ``free`` first joints of a block, once the object moves by x
    and its other joints by theirs; returns the product of both."""
    slope = float(0.0)
    for back in range(free):
        d = free - 1 - back
        k = first + d
        s = -B[k * 7 + 6]
        for a in range(6):
            s -= B[k * 7 + a] * x[a]
        for o in range(d + 1, dofs):
            s -= A[(first + o) * MAX_DOFS + d] * step[first + o]
        s = s / A[k * MAX_DOFS + d]
        slope += step[k] * s
        step[k] = s
    return slope

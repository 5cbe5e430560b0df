"""The linear system of a Newton step: fingers couple through the object and through the joints that they share only,
so each finger's own joints are eliminated by themselves, then the shared ones.

A has lower triangles of the fingers' blocks, then their Cholesky factors, MAX_DOFS numbers a row; B the rows between a
finger and the object; b the gradient. The rows after those of the fingers are the shared joints'; a finger's block has
a copy of each that moves it, after its own joints. C and c are the object's block and gradient.
"""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hold.energy import Material, friction_stiffness, twist_stiffness
from lgrasp.hold.scratch import Contact, Scratch, Terms
from lgrasp.math.kinematics import vec_dof
from lgrasp.math.limits import MAX_DOFS
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_LEAST = wp.constant(1.0e-9)  # of a pivot


@wp.func
def contact_terms(
    m: Material,
    com: wp.vec3,
    contact: Contact,
    group: wp.int32,
    y: wp.vec4,
    at: wp.int32,
    rows: wp.array(dtype=wp.spatial_vector),
    slope: wp.array(dtype=wp.float32),
):
    """Slope and curvature of a contact on a group at its motion y; what it adds to the object's rows and gradient is
    written, from ``at`` on."""
    n = contact.normal
    s = wp.vec3(y[0], y[1], y[2])
    yn = wp.dot(n, s)
    deep = wp.max(-(contact.gap + yn), 0.0)
    limit = m.friction * contact.force
    own = Terms()
    own.group = -1
    RH = wp.mat33(0.0)
    K = wp.mat33(0.0)
    rf = wp.vec3(0.0)
    if deep > 0.0 or limit > 0.0:
        own.group = group
        own.f = n * (-m.contact * deep)
        H = wp.mat33(0.0)
        if deep > 0.0:
            H = wp.outer(n, n) * m.contact
        if limit > 0.0:
            slip = s - n * yn + contact.slip
            far = wp.length(slip)
            k = friction_stiffness(far, m.contact, limit)
            own.f = own.f + slip * k
            H = H + (wp.identity(n=3, dtype=wp.float32) - wp.outer(n, n)) * k
            if k < m.contact:
                H = H - wp.outer(slip, slip) * (k / (far * far))
        own.H = H
        if m.torsion > 0.0:
            twist = y[3] + contact.twist
            k = friction_stiffness(wp.abs(twist), twist_stiffness(m), m.torsion * contact.force)
            own.turn = k * twist
            if k == twist_stiffness(m):
                own.turn_k = k
        own.arm = contact.point - com
        R = wp.skew(own.arm)
        RH = R * H
        K = RH * wp.transpose(R) + wp.outer(n, n) * own.turn_k
        rf = wp.cross(own.arm, own.f) + n * own.turn
    H = own.H
    for a in range(3):
        rows[at + a] = wp.spatial_vector(H[a, 0], H[a, 1], H[a, 2], RH[0, a], RH[1, a], RH[2, a])
        rows[at + 3 + a] = wp.spatial_vector(RH[a, 0], RH[a, 1], RH[a, 2], K[a, 0], K[a, 1], K[a, 2])
        slope[at + a] = -own.f[a]
        slope[at + 3 + a] = -rf[a]
    return own


@wp.func
def set_row(
    hand: Hand, count: wp.int32, group: wp.int32, d: wp.int32, stiffness: wp.float32, slope: wp.float32, w: Scratch
):
    """Write the row of dof d of a group: its own stiffness and slope, and the terms of the contacts on the group."""
    row = vec_dof()
    row[d] = stiffness
    top = wp.vec3(0.0)
    bottom = wp.vec3(0.0)
    for c in range(count):
        if w.terms[c].group == group:
            j = w.column[c * MAX_DOFS + d]
            t = w.spin[c * MAX_DOFS + d]
            turn_k = w.terms[c].turn_k
            h = w.terms[c].H * j
            top -= h
            bottom -= wp.cross(w.terms[c].arm, h) + w.contacts[c].normal * (turn_k * t)
            slope += wp.dot(j, w.terms[c].f) + t * w.terms[c].turn
            for e in range(d + 1):
                row[e] += wp.dot(w.column[c * MAX_DOFS + e], h) + turn_k * t * w.spin[c * MAX_DOFS + e]
    k = hand.kin.dof_first[group] + d
    for e in range(d + 1):
        w.A[k * MAX_DOFS + e] = row[e]
    w.B[k] = wp.spatial_vector(top, bottom)
    w.b[k] = slope
    w.step[k] = slope


@wp.func
def clear_row(k: wp.int32, w: Scratch):
    """Set a row of A and B and its gradient to zero."""
    for e in range(MAX_DOFS):
        w.A[k * MAX_DOFS + e] = 0.0
    w.B[k] = wp.spatial_vector()
    w.b[k] = 0.0
    w.step[k] = 0.0


@wp.func
def eliminate_finger(
    first: wp.int32,
    free: wp.int32,
    dofs: wp.int32,
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.spatial_vector),
    b: wp.array(dtype=wp.float32),
):
    """Factor the ``free`` first rows of a block of ``dofs`` and take their part out of the others, which remain."""
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
        row = B[k]
        slope = b[k]
        for o in range(wp.min(d, free)):
            row -= B[first + o] * A[k * MAX_DOFS + o]
            slope -= b[first + o] * A[k * MAX_DOFS + o]
        if d < free:
            row = row / A[k * MAX_DOFS + d]
            slope = slope / A[k * MAX_DOFS + d]
        B[k] = row
        b[k] = slope


@wp.func
def reduce_object(hand: Hand, w: Scratch):
    """Take the part of all joints out of the object's."""
    for a in range(w.lane, 6, w.lanes):
        row = w.C[a]
        slope = w.c[a]
        for group in range(hand.kin.groups + 1):
            first = hand.kin.dof_first[group]
            end = first + hand.kin.shared
            if group < hand.kin.groups:
                end = first + hand.kin.dof_free[group]
            for k in range(first, end):
                own = w.B[k]
                row -= own * own[a]
                slope -= w.b[k] * own[a]
        w.C[a] = row
        w.c[a] = slope


@wp.func
def gather_shared(hand: Hand, group: wp.int32, w: Scratch):
    """Add what remains of a finger, and its gradient in ``step``, to the rows of the shared joints."""
    first = hand.kin.dof_first[group]
    end = hand.kin.dof_first[hand.kin.groups]
    for k in range(first + hand.kin.dof_free[group], hand.kin.dof_first[group + 1]):
        at = end + hand.kin.dof_shared[k]
        w.step[at] = w.step[at] + w.step[k]
        w.B[at] = w.B[at] + w.B[k]
        w.b[at] = w.b[at] + w.b[k]
        for o in range(first + hand.kin.dof_free[group], k + 1):
            other = hand.kin.dof_shared[o]
            value = w.A[k * MAX_DOFS + o - first]
            place = at * MAX_DOFS + other
            if other > at - end:
                place = (end + other) * MAX_DOFS + at - end
            w.A[place] = w.A[place] + value


@wp.func
def give_shared(hand: Hand, group: wp.int32, w: Scratch):
    """Copy the steps of the shared joints to those of a finger."""
    for k in range(hand.kin.dof_first[group] + hand.kin.dof_free[group], hand.kin.dof_first[group + 1]):
        w.step[k] = w.step[hand.kin.dof_first[hand.kin.groups] + hand.kin.dof_shared[k]]


@wp.func
def solve_object(w: Scratch):
    """x of C x = -c by Cholesky, by every lane for itself."""
    C = wp.spatial_matrix()
    x = wp.spatial_vector()
    for a in range(6):
        row = w.C[a]
        for b in range(a + 1):
            s = row[b]
            for o in range(b):
                s -= C[a, o] * C[b, o]
            if a == b:
                C[a, a] = wp.sqrt(wp.max(s, _LEAST))
            else:
                C[a, b] = s / C[b, b]
        s = -w.c[a]
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
    x: wp.spatial_vector,
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.spatial_vector),
    b: wp.array(dtype=wp.float32),
    step: wp.array(dtype=wp.float32),
):
    """Replace the gradient in ``step`` by the step of the ``free`` first joints of a block, once the object moves by x
    and its other joints by theirs; returns the product of both."""
    slope = float(0.0)
    for back in range(free):
        d = free - 1 - back
        k = first + d
        s = -b[k] - wp.dot(B[k], x)
        for o in range(d + 1, dofs):
            s -= A[(first + o) * MAX_DOFS + d] * step[first + o]
        s = s / A[k * MAX_DOFS + d]
        slope += step[k] * s
        step[k] = s
    return slope

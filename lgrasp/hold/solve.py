"""One quasi-static step of a hand that presses on a free object: the least of its energy, by Newton's method."""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hold.contacts import MAX_TOUCHES, Contact
from lgrasp.hold.energy import (
    LIMIT,
    Body,
    Material,
    beyond_limits,
    contact_slope,
    relative_motion,
    twist_stiffness,
)
from lgrasp.hold.system import (
    add_contact,
    clear_rows,
    eliminate_finger,
    gather_shared,
    give_shared,
    solve_finger,
    solve_object,
)
from lgrasp.math.limits import MAX_DOFS, MAX_GROUPS
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

MAX_HAND_DOFS = MAX_GROUPS * MAX_DOFS
"""Most dofs of all groups together."""
_ROWS = MAX_HAND_DOFS + MAX_DOFS  # those of the shared joints come last
_BLOCKS = _ROWS * MAX_DOFS
_COUPLING = _ROWS * 7
_ITERATIONS = wp.constant(12)
_STOP = wp.constant(1.0e-8)  # [J]
_FORCE_STOP = wp.constant(0.02)  # [N]
_SEARCH = wp.constant(10)  # points tried along a step


@wp.func
def _add_own(
    hand: Hand,
    m: Material,
    body: Body,
    scale: wp.array(dtype=wp.float32),
    q: wp.array(dtype=wp.float32),
    target: wp.array(dtype=wp.float32),
    dq: wp.array(dtype=wp.float32),
    dx: wp.spatial_vector,
    A: wp.array(dtype=wp.float32),
    B: wp.array(dtype=wp.float32),
):
    """Begin a system with the drives and the object by itself; returns C and g of the object."""
    end = hand.kin.dof_first[hand.kin.groups]
    clear_rows(0, end + hand.kin.shared, A, B)
    for group in range(hand.kin.groups):
        first = hand.kin.dof_first[group]
        for d in range(hand.kin.dof_first[group + 1] - first):
            k = first + d
            stiff = m.drive * scale[k]
            drag = m.drag * scale[k]
            over = beyond_limits(hand, k, q[k] + dq[k])
            B[k * 7 + 6] = stiff * (q[k] + dq[k] - target[k] + LIMIT * over) + drag * dq[k]
            A[k * MAX_DOFS + d] = stiff + drag
            if over != 0.0:
                A[k * MAX_DOFS + d] += LIMIT * stiff
    C = wp.spatial_matrix()
    g = wp.spatial_vector()
    r = dx - body.free
    w = body.inertia * wp.spatial_bottom(r)
    for a in range(3):
        C[a, a] = body.mass
        g[a] = body.mass * r[a] - body.force[a]
        g[3 + a] = w[a]
        for b in range(3):
            C[3 + a, 3 + b] = body.inertia[a, b]
    return C, g


@wp.func
def _share_of_step(
    hand: Hand,
    m: Material,
    body: Body,
    contacts: wp.array(dtype=Contact),
    count: wp.int32,
    Y: wp.array(dtype=wp.vec4),
    Z: wp.array(dtype=wp.vec4),
    scale: wp.array(dtype=wp.float32),
    q: wp.array(dtype=wp.float32),
    target: wp.array(dtype=wp.float32),
    dq: wp.array(dtype=wp.float32),
    step: wp.array(dtype=wp.float32),
    dx: wp.spatial_vector,
    move: wp.spatial_vector,
    slope: wp.float32,
):
    """Share of a step after which the energy rises again: where its slope, which only rises, passes zero; 1 at most."""
    turn = wp.spatial_bottom(move)
    w = body.inertia * turn
    r = dx - body.free
    first = wp.dot(w, wp.spatial_bottom(r)) - wp.dot(body.force, wp.spatial_top(move))
    first += body.mass * wp.dot(wp.spatial_top(move), wp.spatial_top(r))
    rise = wp.dot(w, turn) + body.mass * wp.dot(wp.spatial_top(move), wp.spatial_top(move))
    dofs = hand.kin.dof_first[hand.kin.groups]
    for k in range(dofs):
        stiff = m.drive * scale[k]
        drag = m.drag * scale[k]
        first += step[k] * (stiff * (q[k] + dq[k] - target[k]) + drag * dq[k])
        rise += step[k] * step[k] * (stiff + drag)
    low = float(0.0)
    high = float(1.0)
    slope_low = slope
    slope_high = float(0.0)
    share = float(1.0)
    for attempt in range(_SEARCH):
        here = first + share * rise
        for c in range(count):
            here += contact_slope(m, contacts[c], Y[c] + Z[c] * share, Z[c])
        for k in range(dofs):
            over = beyond_limits(hand, k, q[k] + dq[k] + share * step[k])
            here += LIMIT * m.drive * scale[k] * over * step[k]
        if (attempt == 0 and here <= 0.0) or wp.abs(here) < -0.1 * slope:
            break
        # false position; the end that stays counts half
        if here > 0.0:
            high = share
            slope_high = here
            slope_low = 0.5 * slope_low
        else:
            low = share
            slope_low = here
            slope_high = 0.5 * slope_high
        share = (low * slope_high - high * slope_low) / (slope_high - slope_low)
    return share


@wp.func
def _press(m: Material, contacts: wp.array(dtype=Contact), count: wp.int32, Y: wp.array(dtype=wp.vec4)):
    """Set the normal forces, by which friction is bounded, to those at motions Y; returns the largest change [N].

    The points of a patch share its force evenly.
    """
    change = float(0.0)
    first = int(0)
    while first < count:
        end = first
        total = float(0.0)
        while end < count and contacts[end].body == contacts[first].body:
            yn = wp.dot(contacts[end].normal, wp.vec3(Y[end][0], Y[end][1], Y[end][2]))
            total += m.contact * wp.max(-(contacts[end].gap + yn), 0.0)
            end += 1
        force = total / float(end - first)
        for c in range(first, end):
            change = wp.max(change, wp.abs(force - contacts[c].force))
            contacts[c].force = force
        first = end
    return change


@wp.func
def _stretch(m: Material, contacts: wp.array(dtype=Contact), count: wp.int32, Y: wp.array(dtype=wp.vec4)):
    """Take over how far friction is stretched after motions Y; beyond its bound it slips."""
    for c in range(count):
        n = contacts[c].normal
        y = wp.vec3(Y[c][0], Y[c][1], Y[c][2])
        slip = contacts[c].slip + y - n * wp.dot(n, y)
        most = m.friction * contacts[c].force / m.contact
        far = wp.length(slip)
        if far > most:
            slip = slip * (most / far)
        contacts[c].slip = slip
        twist = m.torsion * contacts[c].force / twist_stiffness(m)
        contacts[c].twist = wp.clamp(contacts[c].twist + Y[c][3], -twist, twist)


@wp.func
def solve_step(
    hand: Hand,
    m: Material,
    body: Body,
    contacts: wp.array(dtype=Contact),
    count: wp.int32,
    column: wp.array(dtype=wp.vec3),
    spin: wp.array(dtype=wp.float32),
    scale: wp.array(dtype=wp.float32),
    q: wp.array(dtype=wp.float32),
    target: wp.array(dtype=wp.float32),
    dq: wp.array(dtype=wp.float32),
):
    """Motion of the object [m, rad]; writes that of the joints to ``dq``, and forces and slips of the contacts.

    Args:
        scale: of stiffness by dof, 1 for revolute joints.
        q, target: [rad or m].
    """
    dx = wp.spatial_vector()
    A = wp.zeros(shape=(_BLOCKS,), dtype=wp.float32)
    B = wp.zeros(shape=(_COUPLING,), dtype=wp.float32)
    step = wp.zeros(shape=(_ROWS,), dtype=wp.float32)
    Y = wp.zeros(shape=(MAX_TOUCHES,), dtype=wp.vec4)
    Z = wp.zeros(shape=(MAX_TOUCHES,), dtype=wp.vec4)
    dofs = hand.kin.dof_first[hand.kin.groups]
    shared = hand.kin.shared
    for k in range(dofs):
        dq[k] = 0.0
    for _it in range(_ITERATIONS):
        C, g = _add_own(hand, m, body, scale, q, target, dq, dx, A, B)
        for c in range(count):
            C, g = add_contact(hand, m, contacts[c], c, Y[c], body.com, column, spin, A, B, C, g)
        for k in range(dofs + shared):
            step[k] = B[k * 7 + 6]
        h = g
        for group in range(hand.kin.groups):
            first = hand.kin.dof_first[group]
            members = hand.kin.dof_first[group + 1] - first
            C, h = eliminate_finger(first, hand.kin.dof_free[group], members, A, B, C, h)
            gather_shared(hand, group, A, B, step)
        C, h = eliminate_finger(dofs, shared, shared, A, B, C, h)
        move = solve_object(C, h)
        slope = wp.dot(g, move) + solve_finger(dofs, shared, shared, A, B, move, step)
        for group in range(hand.kin.groups):
            first = hand.kin.dof_first[group]
            members = hand.kin.dof_first[group + 1] - first
            give_shared(hand, group, step)
            slope += solve_finger(first, hand.kin.dof_free[group], members, A, B, move, step)
        for c in range(count):
            Z[c] = relative_motion(hand, contacts[c], c, column, spin, step, move, body.com)
        share = _share_of_step(hand, m, body, contacts, count, Y, Z, scale, q, target, dq, step, dx, move, slope)
        for k in range(dofs):
            dq[k] += share * step[k]
        dx = dx + move * share
        for c in range(count):
            Y[c] = Y[c] + Z[c] * share
        change = _press(m, contacts, count, Y)
        if -slope < _STOP and change < _FORCE_STOP:
            break
    _stretch(m, contacts, count, Y)
    return dx

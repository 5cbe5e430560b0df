"""One quasi-static step of a hand that presses on a free object: the least of its energy, by Newton's method."""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hold.energy import (
    LIMIT,
    Body,
    Material,
    contact_slope,
    drive_effort,
    relative_motion,
    spring_effort,
    stop_effort,
    twist_stiffness,
)
from lgrasp.hold.scratch import Scratch
from lgrasp.hold.system import (
    clear_row,
    contact_terms,
    eliminate_finger,
    gather_shared,
    give_shared,
    reduce_object,
    set_row,
    solve_finger,
    solve_object,
)
from lgrasp.math.lanes import lanes_max, lanes_sum, meet
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_ITERATIONS = wp.constant(20)
_STOP = wp.constant(1.0e-8)  # [J]
_FORCE_STOP = wp.constant(0.02)  # [N]
_NEAR = wp.constant(3.0e-5)  # [m] over which all normal forces do as much work as a step has to gain yet
_SEARCH = wp.constant(10)  # points tried along a step


@wp.func
def _object_row(body: Body, a: wp.int32, dx: wp.spatial_vector):
    """Row a of the object's own block, and its slope at motion dx."""
    r = dx - body.free
    way = wp.vec3()
    way[a % 3] = 1.0
    if a < 3:
        own = wp.dot(wp.spatial_top(r), way) * body.mass - wp.dot(body.force, way)
        return wp.spatial_vector(way * body.mass, wp.vec3()), own
    by_turn = body.inertia * way
    return wp.spatial_vector(wp.vec3(), by_turn), wp.dot(by_turn, wp.spatial_bottom(r))


@wp.func
def _assemble(hand: Hand, m: Material, body: Body, count: wp.int32, dx: wp.spatial_vector, w: Scratch):
    """Write the system at the motion so far, and its gradient by the joints to ``step``."""
    for c in range(w.lane, count, w.lanes):
        group = hand.body_group[w.contacts[c].body]
        w.terms[c] = contact_terms(m, body.com, w.contacts[c], group, w.Y[c], c * 6, w.object_rows, w.object_slope)
    meet()
    end = hand.kin.dof_first[hand.kin.groups]
    for k in range(w.lane, end, w.lanes):
        group = w.group[k]
        drag = m.drag * w.scale[k]
        stiff = m.drive * w.scale[k]
        effort = drive_effort(m, k, w.dq[k], w)
        stop = stop_effort(hand, m, k, w.dq[k], w)
        curvature = drag
        if wp.abs(effort) < w.effort[k]:
            curvature += stiff
        if stop != 0.0:
            curvature += LIMIT * stiff
        set_row(hand, count, group, k - hand.kin.dof_first[group], curvature, effort + stop + drag * w.dq[k], w)
    for k in range(end + w.lane, end + hand.kin.shared, w.lanes):
        clear_row(k, w)
    for a in range(w.lane, 6, w.lanes):
        row, slope = _object_row(body, a, dx)
        for c in range(count):
            row += w.object_rows[c * 6 + a]
            slope += w.object_slope[c * 6 + a]
        w.C[a] = row
        w.c[a] = slope
        w.slope[a] = slope
    meet()


@wp.func
def _solve(hand: Hand, w: Scratch):
    """Step of the object that the system asks for, and the slope of the energy along it and along ``step``, which is
    written."""
    groups = hand.kin.groups
    dofs = hand.kin.dof_first[groups]
    shared = hand.kin.shared
    for group in range(w.lane, groups, w.lanes):
        first = hand.kin.dof_first[group]
        members = hand.kin.dof_first[group + 1] - first
        eliminate_finger(first, hand.kin.dof_free[group], members, w.A, w.B, w.b)
    meet()
    if shared > 0:
        if w.lane == 0:
            for group in range(groups):
                gather_shared(hand, group, w)
            eliminate_finger(dofs, shared, shared, w.A, w.B, w.b)
        meet()
    reduce_object(hand, w)
    meet()
    move = solve_object(w)
    slope = float(0.0)
    if w.lane == 0:
        for a in range(6):
            slope += w.slope[a] * move[a]
        slope += solve_finger(dofs, shared, shared, move, w.A, w.B, w.b, w.step)
    meet()
    for group in range(w.lane, groups, w.lanes):
        first = hand.kin.dof_first[group]
        give_shared(hand, group, w)
        members = hand.kin.dof_first[group + 1] - first
        slope += solve_finger(first, hand.kin.dof_free[group], members, move, w.A, w.B, w.b, w.step)
    meet()
    return move, lanes_sum(slope)


@wp.func
def _share_of_step(
    hand: Hand,
    m: Material,
    body: Body,
    count: wp.int32,
    dx: wp.spatial_vector,
    move: wp.spatial_vector,
    slope: wp.float32,
    w: Scratch,
):
    """Share of a step after which the energy rises again: where its slope, which only rises, passes zero; 1 at most."""
    first = float(0.0)
    rise = float(0.0)
    limited = int(0)
    if w.lane == 0:
        turn = wp.spatial_bottom(move)
        by_turn = body.inertia * turn
        r = dx - body.free
        first = wp.dot(by_turn, wp.spatial_bottom(r)) - wp.dot(body.force, wp.spatial_top(move))
        first += body.mass * wp.dot(wp.spatial_top(move), wp.spatial_top(r))
        rise = wp.dot(by_turn, turn) + body.mass * wp.dot(wp.spatial_top(move), wp.spatial_top(move))
    dofs = hand.kin.dof_first[hand.kin.groups]
    for k in range(w.lane, dofs, w.lanes):
        stiff = m.drive * w.scale[k]
        drag = m.drag * w.scale[k]
        effort = spring_effort(m, k, w.dq[k], w)
        first += w.step[k] * (effort + drag * w.dq[k])
        rise += w.step[k] * w.step[k] * (stiff + drag)
        if wp.max(wp.abs(effort), wp.abs(effort + stiff * w.step[k])) > w.effort[k]:
            limited = 1
    low = float(0.0)
    high = float(1.0)
    slope_low = slope
    slope_high = float(0.0)
    share = float(1.0)
    for attempt in range(_SEARCH):
        here = first + share * rise
        for c in range(w.lane, count, w.lanes):
            here += contact_slope(m, w.contacts[c], w.Y[c] + w.Z[c] * share, w.Z[c])
        for k in range(w.lane, dofs, w.lanes):
            there = w.dq[k] + share * w.step[k]
            here += w.step[k] * stop_effort(hand, m, k, there, w)
            if limited == 1:
                here += w.step[k] * (drive_effort(m, k, there, w) - spring_effort(m, k, there, w))
        here = lanes_sum(here)
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
def _press(m: Material, count: wp.int32, left: wp.float32, w: Scratch):
    """Set the normal forces, by which friction is bounded, to those at motions ``Y``; returns the largest change [N].

    The points of a patch share its force evenly. While there is much energy ``left`` [J] to gain, forces may be beyond
    what the drives press with: they only fall.
    """
    pressing = float(0.0)
    for c in range(w.lane, count, w.lanes):
        y = w.Y[c]
        yn = wp.dot(w.contacts[c].normal, wp.vec3(y[0], y[1], y[2]))
        w.press[c] = m.contact * wp.max(-(w.contacts[c].gap + yn), 0.0)
        pressing += w.press[c]
    near = left < _NEAR * lanes_sum(pressing)
    meet()
    change = float(0.0)
    for c in range(w.lane, count, w.lanes):
        body = w.contacts[c].body
        first = c
        while first > 0 and w.contacts[first - 1].body == body:
            first -= 1
        total = float(0.0)
        end = first
        while end < count and w.contacts[end].body == body:
            total += w.press[end]
            end += 1
        force = total / float(end - first)
        if not near:
            force = wp.min(force, w.contacts[c].force)
        change = wp.max(change, wp.abs(force - w.contacts[c].force))
        w.contacts[c].force = force
    meet()
    return lanes_max(change)


@wp.func
def _stretch(m: Material, count: wp.int32, w: Scratch):
    """Take over how far friction is stretched after motions ``Y``; beyond its bound it slips."""
    for c in range(w.lane, count, w.lanes):
        n = w.contacts[c].normal
        y = wp.vec3(w.Y[c][0], w.Y[c][1], w.Y[c][2])
        slip = w.contacts[c].slip + y - n * wp.dot(n, y)
        most = m.friction * w.contacts[c].force / m.contact
        far = wp.length(slip)
        if far > most:
            slip = slip * (most / far)
        w.contacts[c].slip = slip
        twist = m.torsion * w.contacts[c].force / twist_stiffness(m)
        w.contacts[c].twist = wp.clamp(w.contacts[c].twist + w.Y[c][3], -twist, twist)


@wp.func
def solve_step(hand: Hand, m: Material, body: Body, count: wp.int32, w: Scratch):
    """Motion of the object [m, rad]; writes that of the joints to ``dq``, and forces and slips of the contacts."""
    dx = wp.spatial_vector()
    dofs = hand.kin.dof_first[hand.kin.groups]
    for k in range(w.lane, dofs, w.lanes):
        w.dq[k] = 0.0
    for c in range(w.lane, count, w.lanes):
        w.Y[c] = wp.vec4()
    meet()
    for _it in range(_ITERATIONS):
        _assemble(hand, m, body, count, dx, w)
        move, slope = _solve(hand, w)
        for c in range(w.lane, count, w.lanes):
            w.Z[c] = relative_motion(hand, w.contacts[c], c, w.column, w.spin, w.step, move, body.com)
        share = _share_of_step(hand, m, body, count, dx, move, slope, w)
        for k in range(w.lane, dofs, w.lanes):
            w.dq[k] = w.dq[k] + share * w.step[k]
        dx = dx + move * share
        for c in range(w.lane, count, w.lanes):
            w.Y[c] = w.Y[c] + w.Z[c] * share
        change = _press(m, count, -slope, w)
        if -slope < _STOP and change < _FORCE_STOP:
            break
    _stretch(m, count, w)
    meet()
    return dx

"""Kernels that measure how a grasp's contacts balance, resist loads and hold: residuals, forces, epsilon."""

import warp as wp

from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places
from lgrasp.grasp.outcomes import Outcome
from lgrasp.math.constants import BALANCED, CONE_EDGES
from lgrasp.math.frictionless import centroid
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.loads import unresisted
from lgrasp.math.qp import NO_LIMIT, balance
from lgrasp.math.quality import epsilon_bound
from lgrasp.math.transforms import vec3s
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_CONES = wp.constant(3)  # round ones that are tried, up to the full friction
_LEAST_SHARES = wp.constant(wp.vec2(0.5, 0.3))  # of an even share, that each contact is to bear in one of them
_RESIDUAL_TOLERANCE = wp.constant(1.0e-3)  # by which their residual may be larger


@wp.func
def _contacts(places: Places, surfaces: wp.array(dtype=wp.int32), points: vec3s, normals: vec3s):
    """Points and inward normals of a hand's contacts in the object's frame; returns their number."""
    k = int(0)
    for c in range(surfaces.shape[0]):
        if surfaces[c] >= 0:
            points[k] = places.points[surfaces[c]]
            normals[k] = -places.normals[surfaces[c]]
            k += 1
    return k


@wp.func
def _balanced(
    points: vec3s,
    normals: vec3s,
    k: wp.int32,
    friction: wp.float32,
    edges: wp.int32,
    torque_scale: wp.float32,
    stop: wp.float32,
    limit: wp.float32,
    least: wp.float32,
    forces: vec3s,
):
    """:func:`balance` about the contacts' centroid."""
    middle = centroid(points, k)
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    for c in range(k):
        arms[c] = points[c] - middle
    return balance(arms, normals, k, friction, edges, torque_scale, stop, limit, least, forces)


@wp.kernel
def balance_grasps(limits: Limits, places: Places, at: CheckedPostures, found_out: Findings):
    """FSWO (eq. 1), GSWO (eq. 2, pyramids) and its forces, object frame."""
    i = wp.tid()
    if limits.whole == 1:  # which of several deep places ends the look is chance on a GPU
        found_out.penetration[i] = wp.min(found_out.penetration[i], limits.deepest)
    if found_out.outcome[i] == Outcome.KEPT and found_out.penetration[i] > limits.max_penetration:
        found_out.outcome[i] = Outcome.OBJECT_COLLISION
    if found_out.outcome[i] != Outcome.KEPT and limits.whole == 0:
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(places, at.surface[i], points, normals)
    if k < 2:
        found_out.fswo[i] = 1.0
        found_out.gswo[i] = 1.0
        return
    found_out.fswo[i] = _balanced(points, normals, k, 0.0, 0, limits.torque_scale, 0.0, NO_LIMIT, 0.0, forces)
    scale = limits.torque_scale
    gswo = _balanced(points, normals, k, limits.friction, CONE_EDGES, scale, BALANCED, NO_LIMIT, 0.0, forces)
    found_out.gswo[i] = gswo
    if gswo > limits.max_gswo:
        if found_out.outcome[i] == Outcome.KEPT:
            found_out.outcome[i] = Outcome.BALANCE
        if limits.whole == 0:
            return
    for c in range(k):
        found_out.force[i, c] = forces[c]


@wp.kernel
def resist_loads(obj: Object, limits: Limits, places: Places, at: CheckedPostures, found_out: Findings):
    """One thread per (direction, hand): ``unresisted_load`` grows to the worst direction's."""
    direction, i = wp.tid()
    most = limits.max_unresisted_load
    if limits.whole == 1:
        most = 1.0
    worst = found_out.unresisted_load[i]
    if worst > most or (found_out.outcome[i] != Outcome.KEPT and limits.whole == 0):
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(places, at.surface[i], points, normals)
    if k < 2:
        wp.atomic_max(found_out.unresisted_load, i, 1.0)
        return
    for c in range(k):
        points[c] = points[c] - obj.com
    turn = wp.quat_inverse(wp.transform_get_rotation(at.pose[at.of[i]]))
    # not until it is below the worst so far: the answer would depend on which direction came first
    load = unresisted(points, normals, k, limits.friction, turn, direction, 0.0, most)
    wp.atomic_max(found_out.unresisted_load, i, wp.min(load, 1.0))  # rounding may give more


@wp.kernel
def drop_light(
    places: Places,
    touch: wp.array(dtype=wp.int32),
    least: wp.float32,
    at: CheckedPostures,
    found: Findings,
    row_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """Rows with less than a share of the normal force on contacts in a region become none.

    Args:
        touch: 1 for places on the object in the region, (o,).
        least: of the share.
        row_out: (m,) hand of each row, -1 none.
        counts_out: (reasons,) these rows are moved from those that are kept.
    """
    i = wp.tid()
    s = row_out[i]
    if s < 0:
        return
    on = float(0.0)
    whole = float(0.0)
    for k in range(at.surface.shape[1]):
        c = at.surface[s, k]
        if c >= 0:
            push = -wp.dot(found.force[s, k], places.normals[c])
            whole += push
            if touch[c] > 0:
                on += push
    if on < least * whole:
        row_out[i] = -1
        wp.atomic_sub(counts_out, Outcome.KEPT, 1)
        wp.atomic_add(counts_out, Outcome.TOUCH, 1)


@wp.kernel
def center_forces(
    limits: Limits, places: Places, at: CheckedPostures, row: wp.array(dtype=wp.int32), found_out: Findings
):
    """Balancing forces of the rows kept, in the narrowest of a few round cones that balances as well: if there is one
    with every contact bearing its part, else with any.

    Args:
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(places, at.surface[s], points, normals)
    if k < 2:
        return
    goal = found_out.gswo[s] + _RESIDUAL_TOLERANCE
    enough = goal - 0.5 * _RESIDUAL_TOLERANCE
    attempts = 3 * _CONES - 1  # in the full cone, any forces that balance are there already
    for attempt in range(attempts):
        cone = attempt // 2
        least = _LEAST_SHARES[attempt % 2] / float(k)
        if attempt >= 2 * _CONES:
            cone = attempt - 2 * _CONES
            least = 0.0
        mu = limits.friction * float(cone + 1) / float(_CONES)
        if _balanced(points, normals, k, mu, 0, limits.torque_scale, enough, goal, least, forces) <= goal:
            for c in range(k):
                found_out.force[s, c] = forces[c]
            break


@wp.kernel
def grasp_epsilon(
    obj: Object,
    seed: wp.array(dtype=wp.int32),
    limits: Limits,
    places: Places,
    at: CheckedPostures,
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
):
    """Ferrari-Canny bound of the rows kept about the object's centre of mass.

    Args:
        seed: (1,) random seed.
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    if row[i] < 0:
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(places, at.surface[row[i]], points, normals)
    if k < 2:
        packed_out.epsilon[i] = 0.0
        return
    for c in range(k):
        points[c] = points[c] - obj.com
    packed_out.epsilon[i] = epsilon_bound(points, normals, k, limits.friction, obj.radius, wp.rand_init(seed[0]))

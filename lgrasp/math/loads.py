"""Loads: unit forces on the centre of mass from the six sides of the hand, and what contacts leave of them."""

import warp as wp

from lgrasp.math.constants import LOAD_ARM, LOAD_FORCE
from lgrasp.math.limits import MAX_CONTACTS
from lgrasp.math.qp import Program, least_norm, vec6
from lgrasp.math.transforms import vec3s
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_LOAD_SCALE = wp.constant(1.0 / LOAD_ARM)  # [1/m]
_LOAD_EXACT = wp.constant(1.0e-3)  # relative error of squared norms


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
    return least_norm(arms, normals, k, p, forces)


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

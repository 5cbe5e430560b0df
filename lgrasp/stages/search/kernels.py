"""Kernel of the search stage: block-wise zeroth-order search over the candidates of one pose."""

import warp as wp

from lgrasp.device.kinematics import MAX_JOINTS, group_forward, vec_dof
from lgrasp.device.qp import MAX_CONTACTS, balance, frictionless
from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.hand.arrays import Hand
from lgrasp.hand.clearance import group_pairs_clear
from lgrasp.object.arrays import Object

__all__ = ["MAX_GROUPS", "MAX_KEEP", "search_sets"]

wp.set_module_options(KERNEL_OPTIONS)

MAX_GROUPS = 6
"""Most dependency groups of a hand."""
MAX_KEEP = 64
"""Most candidates per pose and group."""

_KEEP = wp.constant(MAX_KEEP)
_SLOTS = wp.constant(MAX_GROUPS * MAX_KEEP)
_INSCRIBED = wp.constant(0.92388)
"""cos(22.5 deg): the round cone inside an 8-edge cone however the edges are turned."""
vec_set = wp.types.vector(MAX_GROUPS, wp.int32)


@wp.func
def _arms(points: wp.array(dtype=wp.vec3), k: wp.int32, arms: wp.array(dtype=wp.vec3)):
    """Arms of contact points about their centroid."""
    centroid = wp.vec3(0.0)
    for i in range(k):
        centroid = centroid + points[i]
    for i in range(k):
        arms[i] = points[i] - centroid / float(k)
    return k


@wp.func
def _score(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    arms: wp.array(dtype=wp.vec3),
    forces: wp.array(dtype=wp.vec3),
    k: wp.int32,
    mu: wp.float32,
    torque_scale: wp.float32,
):
    """(residual norm, smallest share of the normal force): FSWO when mu = 0, else GSWO."""
    if mu <= 0.0:
        return frictionless(points, normals, k, torque_scale)
    _arms(points, k, arms)
    r = balance(arms, normals, k, mu, 0, torque_scale, 0.0, forces)
    low = float(1.0)
    for i in range(k):
        low = wp.min(low, wp.dot(forces[i], normals[i]))
    return wp.vec2(r, low)


@wp.func
def _same_set(
    hand: Hand,
    chosen: vec_set,
    row: wp.int32,
    first: wp.int32,
    count: wp.int32,
    sets: wp.array3d(dtype=wp.int32),
    q: wp.array3d(dtype=vec_dof),
    separation: wp.float32,
):
    """Is there an earlier set of the pose with the same fingers and nearly the same joints?"""
    for r in range(first, first + count):
        same = int(1)
        for g in range(hand.kin.groups):
            other = sets[row, r, g]
            if (chosen[g] >= 0) != (other >= 0):
                same = 0
                break
            if other >= 0 and other != chosen[g]:
                d = q[row, g, chosen[g]] - q[row, g, other]
                if wp.max(wp.max(d), -wp.min(d)) > separation:
                    same = 0
                    break
        if same == 1:
            return True
    return False


@wp.kernel
def search_sets(
    hand: Hand,
    obj: Object,
    seed: wp.int32,
    contacts: wp.array(dtype=wp.int32),
    friction: wp.float32,
    threshold: wp.float32,
    balanced: wp.float32,
    least_force: wp.float32,
    torque_scale: wp.float32,
    restarts: wp.int32,
    moves: wp.int32,
    per_pose: wp.int32,
    margin: wp.float32,
    separation: wp.float32,
    need: wp.int32,
    with_friction: wp.int32,
    index: wp.array(dtype=wp.int32),
    palm_surface: wp.array(dtype=wp.int32),
    count: wp.array2d(dtype=wp.int32),
    surface: wp.array3d(dtype=wp.int32),
    state_in: wp.array3d(dtype=wp.int32),
    q: wp.array3d(dtype=vec_dof),
    found_out: wp.array(dtype=wp.int32),
    sets_out: wp.array3d(dtype=wp.int32),
    score_out: wp.array2d(dtype=wp.float32),
):
    """Sets of k finger contacts (and the palm's) with small residual (Alg. 2); realised ones also without finger contact.

    ``need`` is the state a candidate must have: 1 = realised (fingers are tested against each other), 0 = as drawn.
    """
    row = wp.tid()
    state = wp.rand_init(seed, index[row])
    G = hand.kin.groups
    alive = wp.zeros(shape=(_SLOTS,), dtype=wp.int32)
    size = vec_set()
    usable = int(0)
    for g in range(G):
        n = int(0)
        for m in range(count[row, g]):
            if state_in[row, g, m] == need:
                alive[g * _KEEP + n] = m
                n += 1
        size[g] = n
        if n > 0:
            usable += 1
    # contacts of a set in the object's frame, where wrench residuals are the same: chosen groups first, then the palm
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    owner = vec_set()
    Xa = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Xb = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    goal = wp.sqrt(threshold)
    palm = palm_surface[row]
    found = int(0)
    mu = float(0.0)
    if with_friction == 1:
        mu = friction * _INSCRIBED
    for _r in range(restarts):
        k = contacts[wp.min(int(wp.randf(state) * float(contacts.shape[0])), contacts.shape[0] - 1)]
        if k > usable:
            k = usable
        if k < 1 or (k < 2 and palm < 0):
            break
        # k random usable groups, a random candidate each
        chosen = vec_set()
        left = usable
        n = int(0)
        for g in range(G):
            chosen[g] = -1
            if size[g] > 0:
                if wp.randf(state) * float(left) < float(k - n):
                    m = alive[g * _KEEP + wp.min(int(wp.randf(state) * float(size[g])), size[g] - 1)]
                    chosen[g] = m
                    owner[n] = g
                    points[n] = obj.contact_points[surface[row, g, m]]
                    normals[n] = -obj.contact_normals[surface[row, g, m]]
                    n += 1
                left -= 1
        k = n
        if palm >= 0:
            points[n] = obj.contact_points[palm]
            normals[n] = -obj.contact_normals[palm]
            n += 1
        score = _score(points, normals, arms, forces, n, mu, torque_scale)
        for _m in range(moves):
            if score[0] < goal and score[1] >= least_force:
                break
            # replace the contact of one chosen group; keep what lowers the residual
            i = wp.min(int(wp.randf(state) * float(k)), k - 1)
            g = owner[i]
            m = alive[g * _KEEP + wp.min(int(wp.randf(state) * float(size[g])), size[g] - 1)]
            old_point = points[i]
            old_normal = normals[i]
            points[i] = obj.contact_points[surface[row, g, m]]
            normals[i] = -obj.contact_normals[surface[row, g, m]]
            trial = _score(points, normals, arms, forces, n, mu, torque_scale)
            if trial[0] < score[0] or (score[0] < goal and trial[0] < goal):
                score = trial
                chosen[g] = m
            else:
                points[i] = old_point
                normals[i] = old_normal
        if score[0] >= goal or score[1] < least_force:
            continue
        if _same_set(hand, chosen, row, 0, found, sets_out, q, separation):
            continue
        _arms(points, n, arms)
        if balance(arms, normals, n, friction * _INSCRIBED, 0, torque_scale, 0.5 * balanced, forces) > balanced:
            continue
        clear = int(1)
        if need == 1:
            for g in range(G):
                if clear == 1 and chosen[g] >= 0:
                    group_forward(hand.kin, g, q[row, g, chosen[g]], Xa, 0)
                    for h in range(g + 1, G):
                        if clear == 1 and chosen[h] >= 0:
                            group_forward(hand.kin, h, q[row, h, chosen[h]], Xb, 0)
                            if not group_pairs_clear(hand, g + 1, h + 1, Xa, 0, Xb, 0, margin):
                                clear = 0
        if clear == 0:
            continue
        for g in range(G):
            sets_out[row, found, g] = chosen[g]
        score_out[row, found] = score[0]
        found += 1
        if found == per_pose:
            break
    found_out[row] = found

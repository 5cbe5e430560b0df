"""Kernel of the search stage: block-wise zeroth-order search over the candidates of one pose."""

import warp as wp

from lgrasp.device.kinematics import MAX_JOINTS, group_forward, vec_dof
from lgrasp.device.qp import MAX_CONTACTS, balance
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
vec_set = wp.types.vector(MAX_GROUPS, wp.int32)


@wp.func
def _load(
    obj: Object,
    T: wp.transform,
    hand: Hand,
    palm: wp.int32,
    palm_surface: wp.int32,
    chosen: vec_set,
    row: wp.int32,
    surface: wp.array3d(dtype=wp.int32),
    arms: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
):
    """Arms about the centroid and inward object normals (base frame) of a set; returns the number of contacts."""
    k = int(0)
    centroid = wp.vec3(0.0)
    for g in range(hand.kin.groups):
        if chosen[g] >= 0:
            s = surface[row, g, chosen[g]]
            arms[k] = wp.transform_point(T, obj.contact_points[s])
            normals[k] = -wp.transform_vector(T, obj.contact_normals[s])
            centroid = centroid + arms[k]
            k += 1
    if palm >= 0:
        arms[k] = wp.transform_point(T, obj.contact_points[palm_surface])
        normals[k] = -wp.transform_vector(T, obj.contact_normals[palm_surface])
        centroid = centroid + arms[k]
        k += 1
    centroid = centroid / float(k)
    for i in range(k):
        arms[i] = arms[i] - centroid
    return k


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
    pose: wp.array(dtype=wp.transform),
    palm_point: wp.array(dtype=wp.int32),
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
    T = pose[row]
    palm = palm_point[row]
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    Xa = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Xb = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    goal = wp.sqrt(threshold)
    found = int(0)
    mu = float(0.0)
    if with_friction == 1:
        mu = friction * 0.92388
    for _r in range(restarts):
        k = contacts[wp.min(int(wp.randf(state) * float(contacts.shape[0])), contacts.shape[0] - 1)]
        if k > usable:
            k = usable
        if k < 2 and palm < 0 or k < 1:
            break
        # k random usable groups, a random candidate each
        chosen = vec_set()
        left = usable
        want = k
        for g in range(G):
            chosen[g] = -1
            if size[g] > 0:
                if wp.randf(state) * float(left) < float(want):
                    chosen[g] = alive[g * _KEEP + wp.min(int(wp.randf(state) * float(size[g])), size[g] - 1)]
                    want -= 1
                left -= 1
        n = _load(obj, T, hand, palm, palm_surface[row], chosen, row, surface, arms, normals)
        score = balance(arms, normals, n, mu, 0, torque_scale, 0.0, forces)
        for _m in range(moves):
            low = float(1.0)
            for i in range(n):
                low = wp.min(low, wp.dot(forces[i], normals[i]))
            if score < goal and low >= least_force:
                break
            # replace the contact of one chosen group
            pick = int(wp.randf(state) * float(k))
            g = int(0)
            for h in range(G):
                if chosen[h] >= 0:
                    if pick == 0:
                        g = h
                    pick -= 1
            trial = chosen
            trial[g] = alive[g * _KEEP + wp.min(int(wp.randf(state) * float(size[g])), size[g] - 1)]
            _load(obj, T, hand, palm, palm_surface[row], trial, row, surface, arms, normals)
            s = balance(arms, normals, n, mu, 0, torque_scale, 0.0, forces)
            if s < score or (score < goal and s < goal):
                chosen = trial
                score = s
        _load(obj, T, hand, palm, palm_surface[row], chosen, row, surface, arms, normals)
        score = balance(arms, normals, n, mu, 0, torque_scale, 0.0, forces)
        low = float(1.0)
        for i in range(n):
            low = wp.min(low, wp.dot(forces[i], normals[i]))
        if score >= goal or low < least_force:
            continue
        if _same_set(hand, chosen, row, 0, found, sets_out, q, separation):
            continue
        # with friction, on the round cone inscribed in every 8-edge cone
        if balance(arms, normals, n, friction * 0.92388, 0, torque_scale, 0.5 * balanced, forces) > balanced:
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
        score_out[row, found] = score
        found += 1
        if found == per_pose:
            break
    found_out[row] = found

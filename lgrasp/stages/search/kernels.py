"""Kernels of the search stage: block-wise zeroth-order search from many random starts, then the sets that are kept."""

from typing import Any

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.constants import INSCRIBED
from lgrasp.math.kinematics import MAX_GROUPS, MAX_JOINTS, group_forward, vec_dof
from lgrasp.math.qp import MAX_CONTACTS, balance, frictionless, unresisted_load
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.search.params import MAX_KINDS

wp.set_module_options(KERNEL_OPTIONS)

MAX_KEEP = 64
"""Most candidates per pose and group."""

_INSCRIBED = wp.constant(INSCRIBED)
vec_set = wp.types.vector(MAX_GROUPS, wp.int32)
vec_kinds = wp.types.vector(MAX_KINDS, wp.int32)


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
def _frictionless(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    k: wp.int32,
    friction: wp.float32,
    torque_scale: wp.float32,
):
    """(FSWO residual norm, smallest share of the normal force)."""
    return frictionless(points, normals, k, torque_scale)


@wp.func
def _with_friction(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    k: wp.int32,
    friction: wp.float32,
    torque_scale: wp.float32,
):
    """(GSWO residual norm, smallest share of the normal force)."""
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    _arms(points, k, arms)
    r = balance(arms, normals, k, friction * _INSCRIBED, 0, torque_scale, 0.0, forces)
    low = float(1.0)
    for i in range(k):
        low = wp.min(low, wp.dot(forces[i], normals[i]))
    return wp.vec2(r, low)


@wp.kernel
def list_usable(
    need: wp.int32,
    count: wp.array2d(dtype=wp.int32),
    state: wp.array3d(dtype=wp.int32),
    size_out: wp.array2d(dtype=wp.int32),
    usable_out: wp.array3d(dtype=wp.int32),
):
    """Candidates of each (pose, group) in the needed state: 1 = realised, 0 = as drawn."""
    row, g = wp.tid()
    n = int(0)
    for m in range(count[row, g]):
        if state[row, g, m] == need:
            usable_out[row, g, n] = m
            n += 1
    size_out[row, g] = n


def _starts(measure: Any) -> Any:
    """The search kernel for one residual; what it does not need would only take registers."""

    @wp.kernel
    def try_starts(
        groups: wp.int32,
        obj: Object,
        seed: wp.array(dtype=wp.int32),
        first: wp.int32,
        contacts: vec_kinds,
        kinds: wp.int32,
        friction: wp.float32,
        threshold: wp.float32,
        least_force: wp.float32,
        torque_scale: wp.float32,
        moves: wp.int32,
        rounds: wp.int32,
        per_pose: wp.int32,
        index: wp.array(dtype=wp.int32),
        palm_surface: wp.array(dtype=wp.int32),
        surface: wp.array3d(dtype=wp.int32),
        size: wp.array2d(dtype=wp.int32),
        usable: wp.array3d(dtype=wp.int32),
        found: wp.array(dtype=wp.int32),
        chosen_out: wp.array3d(dtype=wp.int32),
        score_out: wp.array2d(dtype=wp.float32),
    ):
        """One thread per (pose, start): a set of k finger contacts (and the palm's) with small residual (Alg. 2).

        ``score_out`` is below 0 when the start found none. Poses that have ``per_pose`` sets already are left alone.
        """
        row, lane = wp.tid()
        score_out[row, lane] = -1.0
        if found[row] >= per_pose:
            return
        G = groups
        state = wp.rand_init(seed[0], index[row] * 4096 + first + lane)
        available = int(0)
        for g in range(G):
            if size[row, g] > 0:
                available += 1
        palm = palm_surface[row]
        k = contacts[wp.min(int(wp.randf(state) * float(kinds)), kinds - 1)]
        if k > available:
            # the palm's contact may stand in for one finger
            if palm < 0 or k - 1 > available or available == 0:
                return
            k = available
        # contacts in the object's frame, where wrench residuals are the same: chosen groups first, then the palm
        points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
        normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
        chosen = vec_set()
        owner = vec_set()
        left = available
        n = int(0)
        for g in range(G):
            chosen[g] = -1
            if size[row, g] > 0:
                if wp.randf(state) * float(left) < float(k - n):
                    m = usable[row, g, wp.min(int(wp.randf(state) * float(size[row, g])), size[row, g] - 1)]
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
        goal = wp.sqrt(threshold)
        score = measure(points, normals, n, friction, torque_scale)
        # the most finger contacts a set may come to have
        most = int(0)
        for i in range(kinds):
            most = wp.max(most, contacts[i])
        most = wp.min(most, available)
        free = int(0)  # contacts before this one stay: they were searched in an earlier round
        for r in range(rounds):
            for _m in range(moves):
                if score[0] < goal and score[1] >= least_force:
                    break
                # replace the contact of one chosen group; keep what lowers the residual
                i = free + wp.min(int(wp.randf(state) * float(k - free)), k - free - 1)
                g = owner[i]
                m = usable[row, g, wp.min(int(wp.randf(state) * float(size[row, g])), size[row, g] - 1)]
                old_point = points[i]
                old_normal = normals[i]
                points[i] = obj.contact_points[surface[row, g, m]]
                normals[i] = -obj.contact_normals[surface[row, g, m]]
                trial = measure(points, normals, n, friction, torque_scale)
                if trial[0] < score[0] or (score[0] < goal and trial[0] < goal):
                    score = trial
                    chosen[g] = m
                else:
                    points[i] = old_point
                    normals[i] = old_normal
            if (score[0] < goal and score[1] >= least_force) or k >= most or r + 1 == rounds:
                break
            # the set lacks stability: add a contact of an unused finger, and search that one
            skip = wp.min(int(wp.randf(state) * float(available - k)), available - k - 1)
            added = int(-1)
            for g in range(G):
                if added < 0 and size[row, g] > 0 and chosen[g] < 0:
                    if skip == 0:
                        added = g
                    skip -= 1
            if palm >= 0:
                points[n] = points[k]
                normals[n] = normals[k]
            m = usable[row, added, wp.min(int(wp.randf(state) * float(size[row, added])), size[row, added] - 1)]
            chosen[added] = m
            owner[k] = added
            points[k] = obj.contact_points[surface[row, added, m]]
            normals[k] = -obj.contact_normals[surface[row, added, m]]
            free = k
            k += 1
            n += 1
            score = measure(points, normals, n, friction, torque_scale)
        if score[0] >= goal or score[1] < least_force:
            return
        for g in range(G):
            chosen_out[row, lane, g] = chosen[g]
        score_out[row, lane] = score[0]

    return try_starts


try_starts = {"fswo": _starts(_frictionless), "gswo": _starts(_with_friction)}
"""Kernels by residual."""


@wp.kernel
def list_hits(
    score: wp.array2d(dtype=wp.float32),
    number_out: wp.array(dtype=wp.int32),
    hits_out: wp.array(dtype=wp.int32),
):
    """Flat places of the scores from 0 on, in any order."""
    row, lane = wp.tid()
    if score[row, lane] >= 0.0:
        hits_out[wp.atomic_add(number_out, 0, 1)] = row * score.shape[1] + lane


@wp.kernel
def check_starts(
    number: wp.array(dtype=wp.int32),
    hits: wp.array(dtype=wp.int32),
    hand: Hand,
    obj: Object,
    friction: wp.float32,
    balanced: wp.float32,
    most: wp.float32,
    torque_scale: wp.float32,
    margin: wp.float32,
    realised: wp.int32,
    pose: wp.array(dtype=wp.transform),
    palm_surface: wp.array(dtype=wp.int32),
    surface: wp.array3d(dtype=wp.int32),
    q: wp.array3d(dtype=vec_dof),
    chosen: wp.array3d(dtype=wp.int32),
    score_out: wp.array2d(dtype=wp.float32),
):
    """Scores of hits go below 0 when friction does not balance them or lets go of the object, or when fingers meet."""
    i = wp.tid()
    if i >= number[0]:
        return
    row = hits[i] // score_out.shape[1]
    lane = hits[i] - row * score_out.shape[1]
    G = hand.kin.groups
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    n = int(0)
    for g in range(G + 1):
        s = int(-1)
        if g == G:
            s = palm_surface[row]
        elif chosen[row, lane, g] >= 0:
            s = surface[row, g, chosen[row, lane, g]]
        if s >= 0:
            points[n] = obj.contact_points[s]
            normals[n] = -obj.contact_normals[s]
            n += 1
    _arms(points, n, arms)
    if balance(arms, normals, n, friction * _INSCRIBED, 0, torque_scale, 0.5 * balanced, forces) > balanced:
        score_out[row, lane] = -1.0
        return
    if most < 1.0:
        for c in range(n):
            points[c] = points[c] - obj.com
        turn = wp.quat_inverse(wp.transform_get_rotation(pose[row]))
        if unresisted_load(points, normals, n, friction, turn, most) > most:
            score_out[row, lane] = -1.0
            return
    if realised == 0:
        return
    Xa = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Xb = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    for g in range(G):
        if chosen[row, lane, g] >= 0:
            group_forward(hand.kin, g, q[row, g, chosen[row, lane, g]], Xa, 0)
            for h in range(g + 1, G):
                if chosen[row, lane, h] >= 0:
                    group_forward(hand.kin, h, q[row, h, chosen[row, lane, h]], Xb, 0)
                    if not group_pairs_clear(hand, g + 1, h + 1, Xa, 0, Xb, 0, margin):
                        score_out[row, lane] = -1.0
                        return


@wp.kernel
def keep_sets(
    groups: wp.int32,
    per_pose: wp.int32,
    separation: wp.float32,
    q: wp.array3d(dtype=vec_dof),
    chosen: wp.array3d(dtype=wp.int32),
    score: wp.array2d(dtype=wp.float32),
    found_out: wp.array(dtype=wp.int32),
    sets_out: wp.array3d(dtype=wp.int32),
    score_out: wp.array2d(dtype=wp.float32),
):
    """One thread per pose: the first ``per_pose`` sets in the order of the starts, without near-repetitions.

    A set repeats another when the same fingers touch and all their joints are within ``separation``.
    """
    row = wp.tid()
    n = found_out[row]
    for lane in range(score.shape[1]):
        if n < per_pose and score[row, lane] >= 0.0:
            fresh = int(1)
            for r in range(n):
                same = int(1)
                for g in range(groups):
                    a = chosen[row, lane, g]
                    b = sets_out[row, r, g]
                    if (a >= 0) != (b >= 0):
                        same = 0
                    elif a >= 0 and a != b:
                        d = q[row, g, a] - q[row, g, b]
                        if wp.max(wp.max(d), -wp.min(d)) > separation:
                            same = 0
                if same == 1:
                    fresh = 0
            if fresh == 1:
                for g in range(groups):
                    sets_out[row, n, g] = chosen[row, lane, g]
                score_out[row, n] = score[row, lane]
                n += 1
    found_out[row] = n


@wp.kernel
def take_sets(
    upto: wp.array(dtype=wp.int32),
    poses: wp.array(dtype=wp.int32),
    slot: wp.int32,
    found: wp.array(dtype=wp.int32),
    sets: wp.array3d(dtype=wp.int32),
    score: wp.array2d(dtype=wp.float32),
    pose_out: wp.array(dtype=wp.int32),
    slot_out: wp.array(dtype=wp.int32),
    chosen_out: wp.array2d(dtype=wp.int32),
    score_out: wp.array(dtype=wp.float32),
    rows_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """Rows of the ContactSets, ``upto[row]`` of them for the first ``row + 1`` poses; slots are counted from ``slot``.

    ``counts_out`` gets the poses, those that yield and the sets.
    """
    row = wp.tid()
    if row == upto.shape[0] - 1:
        rows_out[0] = upto[row]
        counts_out[0] = poses[0]
        counts_out[2] = upto[row]
    if found[row] > 0:
        wp.atomic_add(counts_out, 1, 1)
    for k in range(found[row]):
        i = upto[row] - found[row] + k
        pose_out[i] = row
        slot_out[i] = slot + k
        score_out[i] = score[row, k]
        for g in range(sets.shape[2]):
            chosen_out[i, g] = sets[row, k, g]

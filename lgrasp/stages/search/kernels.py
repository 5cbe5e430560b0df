"""Kernels of the search stage: block-wise zeroth-order search from many random starts, then the sets that are kept."""

from enum import IntEnum
from typing import Any

import warp as wp

from lgrasp.grasp.structs import Candidates, Sets
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.constants import INSCRIBED
from lgrasp.math.kinematics import MAX_GROUPS, MAX_JOINTS, group_forward
from lgrasp.math.qp import MAX_CONTACTS, balance, frictionless, unresisted_load
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.search.params import MAX_KINDS, MAX_RESTARTS

wp.set_module_options(KERNEL_OPTIONS)

_INSCRIBED = wp.constant(INSCRIBED)
_STARTS = wp.constant(MAX_RESTARTS)
vec_set = wp.types.vector(MAX_GROUPS, wp.int32)
vec_kinds = wp.types.vector(MAX_KINDS, wp.int32)


class SearchCount(IntEnum):
    """What the stage counts."""

    POSES = 0
    YIELDING = 1
    SETS = 2


@wp.struct
class SearchValues:
    """SearchParams and GraspBounds as kernels read them."""

    contacts: vec_kinds
    kinds: wp.int32  # entries of ``contacts``
    threshold: wp.float32  # of the squared residual
    friction: wp.float32
    max_gswo: wp.float32
    max_unresisted_load: wp.float32
    least_force: wp.float32
    torque_scale: wp.float32  # [1/m]
    moves: wp.int32
    rounds: wp.int32
    per_pose: wp.int32
    min_self_distance: wp.float32  # [m]
    separation: wp.float32  # [rad]


@wp.struct
class Usable:
    """Candidates that may be combined."""

    size: wp.array2d(dtype=wp.int32)  # (P, G) how many
    candidate: wp.array3d(dtype=wp.int32)  # (P, G, M) which: the first ``size``


@wp.struct
class TriedSets:
    """What L starts at each pose came to."""

    chosen: wp.array3d(dtype=wp.int32)  # (P, L, G) candidate of each group, -1 unused
    score: wp.array2d(dtype=wp.float32)  # (P, L) norm of the residual wrench, below 0: no set


@wp.struct
class FoundSets:
    """Up to S sets of each pose."""

    number: wp.array(dtype=wp.int32)  # (P,) how many
    chosen: wp.array3d(dtype=wp.int32)  # (P, S, G) candidate of each group, -1 unused
    score: wp.array2d(dtype=wp.float32)  # (P, S) norm of the residual wrench


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
    # in
    state: wp.int32,
    candidates: Candidates,
    # out
    usable_out: Usable,
):
    """Candidates of each (pose, group) in one State."""
    row, g = wp.tid()
    n = int(0)
    for m in range(candidates.count[row, g]):
        if candidates.state[row, g, m] == state:
            usable_out.candidate[row, g, n] = m
            n += 1
    usable_out.size[row, g] = n


@wp.func
def _any(usable: Usable, row: wp.int32, g: wp.int32, u: wp.float32):
    """One of the usable candidates of a group, u in [0, 1)."""
    n = usable.size[row, g]
    return usable.candidate[row, g, wp.min(int(u * float(n)), n - 1)]


def _starts(measure: Any) -> Any:
    """The search kernel for one residual; what it does not need would only take registers."""

    @wp.kernel
    def try_starts(
        # in
        obj: Object,
        params: SearchValues,
        seed: wp.array(dtype=wp.int32),
        first: wp.int32,
        candidates: Candidates,
        usable: Usable,
        found: FoundSets,
        # out
        tried_out: TriedSets,
    ):
        """One thread per (pose, start): finger contacts (and the palm's) with small residual (Alg. 2 for eq. 6).

        The domains D_i are the usable candidates; one contact at a time is replaced by another of its D_i, and what
        lowers the residual J stays. Poses that have ``per_pose`` sets already are left alone.

        Args:
            seed: of the stage, (1,).
            first: number of start 0.
        """
        row, lane = wp.tid()
        tried_out.score[row, lane] = -1.0
        if found.number[row] >= params.per_pose:
            return
        G = usable.size.shape[1]
        state = wp.rand_init(seed[0], candidates.poses.index[row] * _STARTS + first + lane)
        available = int(0)
        for g in range(G):
            if usable.size[row, g] > 0:
                available += 1
        palm = candidates.poses.palm_surface[row]
        k = params.contacts[wp.min(int(wp.randf(state) * float(params.kinds)), params.kinds - 1)]
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
            if usable.size[row, g] > 0:
                if wp.randf(state) * float(left) < float(k - n):
                    m = _any(usable, row, g, wp.randf(state))
                    chosen[g] = m
                    owner[n] = g
                    points[n] = obj.contact_points[candidates.surface[row, g, m]]
                    normals[n] = -obj.contact_normals[candidates.surface[row, g, m]]
                    n += 1
                left -= 1
        k = n
        if palm >= 0:
            points[n] = obj.contact_points[palm]
            normals[n] = -obj.contact_normals[palm]
            n += 1
        goal = wp.sqrt(params.threshold)
        score = measure(points, normals, n, params.friction, params.torque_scale)
        # the most finger contacts a set may come to have
        most = int(0)
        for i in range(params.kinds):
            most = wp.max(most, params.contacts[i])
        most = wp.min(most, available)
        free = int(0)  # contacts before this one stay: they were searched in an earlier round
        for r in range(params.rounds):
            for _m in range(params.moves):
                if score[0] < goal and score[1] >= params.least_force:
                    break
                # replace the contact of one chosen group; keep what lowers the residual
                i = free + wp.min(int(wp.randf(state) * float(k - free)), k - free - 1)
                g = owner[i]
                m = _any(usable, row, g, wp.randf(state))
                old_point = points[i]
                old_normal = normals[i]
                points[i] = obj.contact_points[candidates.surface[row, g, m]]
                normals[i] = -obj.contact_normals[candidates.surface[row, g, m]]
                trial = measure(points, normals, n, params.friction, params.torque_scale)
                if trial[0] < score[0] or (score[0] < goal and trial[0] < goal):
                    score = trial
                    chosen[g] = m
                else:
                    points[i] = old_point
                    normals[i] = old_normal
            if (score[0] < goal and score[1] >= params.least_force) or k >= most or r + 1 == params.rounds:
                break
            # the set lacks stability: add a contact of an unused finger, and search that one
            skip = wp.min(int(wp.randf(state) * float(available - k)), available - k - 1)
            added = int(-1)
            for g in range(G):
                if added < 0 and usable.size[row, g] > 0 and chosen[g] < 0:
                    if skip == 0:
                        added = g
                    skip -= 1
            if palm >= 0:
                points[n] = points[k]
                normals[n] = normals[k]
            m = _any(usable, row, added, wp.randf(state))
            chosen[added] = m
            owner[k] = added
            points[k] = obj.contact_points[candidates.surface[row, added, m]]
            normals[k] = -obj.contact_normals[candidates.surface[row, added, m]]
            free = k
            k += 1
            n += 1
            score = measure(points, normals, n, params.friction, params.torque_scale)
        if score[0] >= goal or score[1] < params.least_force:
            return
        for g in range(G):
            tried_out.chosen[row, lane, g] = chosen[g]
        tried_out.score[row, lane] = score[0]

    return try_starts


try_starts = {"fswo": _starts(_frictionless), "gswo": _starts(_with_friction)}
"""Kernels by residual."""


@wp.kernel
def list_hits(
    # in
    tried: TriedSets,
    # out
    number_out: wp.array(dtype=wp.int32),
    hits_out: wp.array(dtype=wp.int32),
):
    """The starts that found a set, in any order.

    Args:
        number_out: how many, (1,), zero on entry.
        hits_out: their flat places, (P L,).
    """
    row, lane = wp.tid()
    if tried.score[row, lane] >= 0.0:
        hits_out[wp.atomic_add(number_out, 0, 1)] = row * tried.score.shape[1] + lane


@wp.kernel
def check_starts(
    # in
    number: wp.array(dtype=wp.int32),
    hits: wp.array(dtype=wp.int32),
    hand: Hand,
    obj: Object,
    params: SearchValues,
    realised: wp.int32,
    candidates: Candidates,
    # out
    tried_out: TriedSets,
):
    """Scores of hits go below 0 when friction does not balance them or lets go of the object, or when fingers meet.

    Args:
        number: hits, (1,).
        hits: flat places of the starts that found a set, (P L,).
        realised: 1 if postures make the contacts, so that fingers can be tested against each other.
    """
    i = wp.tid()
    if i >= number[0]:
        return
    row = hits[i] // tried_out.score.shape[1]
    lane = hits[i] - row * tried_out.score.shape[1]
    G = hand.kin.groups
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    n = int(0)
    for g in range(G + 1):
        s = int(-1)
        if g == G:
            s = candidates.poses.palm_surface[row]
        elif tried_out.chosen[row, lane, g] >= 0:
            s = candidates.surface[row, g, tried_out.chosen[row, lane, g]]
        if s >= 0:
            points[n] = obj.contact_points[s]
            normals[n] = -obj.contact_normals[s]
            n += 1
    _arms(points, n, arms)
    limit = params.max_gswo
    if balance(arms, normals, n, params.friction * _INSCRIBED, 0, params.torque_scale, 0.5 * limit, forces) > limit:
        tried_out.score[row, lane] = -1.0
        return
    if params.max_unresisted_load < 1.0:
        for c in range(n):
            points[c] = points[c] - obj.com
        turn = wp.quat_inverse(wp.transform_get_rotation(candidates.poses.pose[row]))
        limit = params.max_unresisted_load
        if unresisted_load(points, normals, n, params.friction, turn, limit) > limit:
            tried_out.score[row, lane] = -1.0
            return
    if realised == 0:
        return
    Xa = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Xb = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    for g in range(G):
        if tried_out.chosen[row, lane, g] >= 0:
            group_forward(hand.kin, g, candidates.q[row, g, tried_out.chosen[row, lane, g]], Xa, 0)
            for h in range(g + 1, G):
                if tried_out.chosen[row, lane, h] >= 0:
                    group_forward(hand.kin, h, candidates.q[row, h, tried_out.chosen[row, lane, h]], Xb, 0)
                    if not group_pairs_clear(hand, g + 1, h + 1, Xa, 0, Xb, 0, params.min_self_distance):
                        tried_out.score[row, lane] = -1.0
                        return


@wp.func
def _repeats(
    params: SearchValues,
    candidates: Candidates,
    tried: TriedSets,
    found: FoundSets,
    row: wp.int32,
    lane: wp.int32,
    r: wp.int32,
):
    """Has found set r the same fingers as the tried one, and all their joints within ``separation``?"""
    for g in range(tried.chosen.shape[2]):
        a = tried.chosen[row, lane, g]
        b = found.chosen[row, r, g]
        if (a >= 0) != (b >= 0):
            return False
        if a >= 0 and a != b:
            d = candidates.q[row, g, a] - candidates.q[row, g, b]
            if wp.max(wp.max(d), -wp.min(d)) > params.separation:
                return False
    return True


@wp.kernel
def keep_sets(
    # in
    params: SearchValues,
    candidates: Candidates,
    tried: TriedSets,
    # out
    found_out: FoundSets,
):
    """One thread per pose: the first ``per_pose`` sets in the order of the starts, without near-repetitions."""
    row = wp.tid()
    n = found_out.number[row]
    for lane in range(tried.score.shape[1]):
        if n < params.per_pose and tried.score[row, lane] >= 0.0:
            fresh = bool(True)
            for r in range(n):
                if fresh and _repeats(params, candidates, tried, found_out, row, lane, r):
                    fresh = False
            if fresh:
                for g in range(tried.chosen.shape[2]):
                    found_out.chosen[row, n, g] = tried.chosen[row, lane, g]
                found_out.score[row, n] = tried.score[row, lane]
                n += 1
    found_out.number[row] = n


@wp.kernel
def take_sets(
    # in
    upto: wp.array(dtype=wp.int32),
    candidates: Candidates,
    slot: wp.int32,
    found: FoundSets,
    # out
    sets_out: Sets,
    counts_out: wp.array(dtype=wp.int32),
):
    """Rows of the ContactSets; slots are counted from ``slot``.

    Args:
        upto: sets of the first ``row + 1`` poses, (P,).
        counts_out: SearchCount, (3,).
    """
    row = wp.tid()
    number = found.number[row]
    if row == upto.shape[0] - 1:
        sets_out.rows[0] = upto[row]
        counts_out[int(SearchCount.POSES)] = candidates.poses.rows[0]
        counts_out[int(SearchCount.SETS)] = upto[row]
    if number > 0:
        wp.atomic_add(counts_out, SearchCount.YIELDING, 1)
    for k in range(number):
        i = upto[row] - number + k
        sets_out.pose[i] = row
        sets_out.slot[i] = slot + k
        sets_out.score[i] = found.score[row, k]
        for g in range(found.chosen.shape[2]):
            sets_out.chosen[i, g] = found.chosen[row, k, g]

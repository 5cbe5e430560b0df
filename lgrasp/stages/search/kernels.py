"""Kernels of the search stage shared by its methods: usable contacts, sound sets, sets that are kept."""

from enum import IntEnum

import warp as wp

from lgrasp.grasp.structs import FURTHER, Candidates, Sets, further_contacts
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.constants import INSCRIBED
from lgrasp.math.kinematics import group_forward
from lgrasp.math.limits import MAX_CONTACTS, MAX_JOINTS
from lgrasp.math.loads import by_difficulty, unresisted
from lgrasp.math.qp import balances
from lgrasp.math.transforms import vec3s
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.search.sets import FoundSets, Hits, SearchValues, TriedSets, Usable, centred, put_contact

wp.set_module_options(KERNEL_OPTIONS)


class SearchCount(IntEnum):
    """Counts of the stage."""

    POSES = 0
    YIELDING = 1
    SETS = 2


@wp.kernel
def list_usable(obj: Object, state: wp.int32, candidates: Candidates, usable_out: Usable):
    """Candidates of each (pose, group) in one State, those whose finger touches with most links first."""
    row, g = wp.tid()
    n = int(0)
    ranks = wp.where(usable_out.ranked == 1, FURTHER + 1, 1)
    for r in range(ranks):
        for m in range(candidates.count[row, g]):
            wanted = candidates.state[row, g, m] == state
            if wanted and usable_out.ranked == 1:
                wanted = further_contacts(candidates, row, g, m) == FURTHER - r
            if wanted:
                usable_out.candidate[row, g, n] = m
                if usable_out.point.shape[2] > 0:
                    usable_out.point[row, g, n] = obj.contact_points[candidates.surface[row, g, m]]
                n += 1
    usable_out.size[row, g] = n


@wp.kernel
def leave_poor(params: SearchValues, candidates: Candidates, usable_out: Usable):
    """Poses are left alone where all fingers together, each with its richest candidate, make too few contacts."""
    row = wp.tid()
    most = wp.where(candidates.poses.palm_surface[row] >= 0, 1, 0)
    for g in range(usable_out.size.shape[1]):
        if usable_out.size[row, g] > 0:
            most += 1 + further_contacts(candidates, row, g, usable_out.candidate[row, g, 0])
    usable_out.most[row] = most
    if most < params.min_contacts:
        for g in range(usable_out.size.shape[1]):
            usable_out.size[row, g] = 0


@wp.kernel
def list_hits(tried: TriedSets, hits_out: Hits):
    """The starts whose set stands, in any order; their number is zero on entry."""
    row, lane = wp.tid()
    if tried.score[row, lane] >= 0.0:
        hits_out.start[wp.atomic_add(hits_out.number, 0, 1)] = row * tried.score.shape[1] + lane


@wp.func
def hit_at(hits: Hits, tried: TriedSets, i: wp.int32):
    """Row and lane of hit i; the row is -1 if it has failed already."""
    row = hits.start[i] // tried.score.shape[1]
    lane = hits.start[i] - row * tried.score.shape[1]
    if tried.score[row, lane] < 0.0:
        row = -1
    return row, lane


@wp.func
def _contacts(
    obj: Object,
    candidates: Candidates,
    tried: TriedSets,
    row: wp.int32,
    lane: wp.int32,
    points: vec3s,
    normals: vec3s,
):
    """Number of contacts of a set, in ``points`` and ``normals``: one of each finger, the palm's, then those of their
    other links."""
    n = int(0)
    for g in range(tried.chosen.shape[2]):
        if tried.chosen[row, lane, g] >= 0:
            n = put_contact(obj, candidates.surface[row, g, tried.chosen[row, lane, g]], n, points, normals)
    if candidates.poses.palm_surface[row] >= 0:
        n = put_contact(obj, candidates.poses.palm_surface[row], n, points, normals)
    if candidates.further.shape[2] > 0:
        for k in range(FURTHER):
            for g in range(tried.chosen.shape[2]):
                m = tried.chosen[row, lane, g]
                if m >= 0 and n < MAX_CONTACTS:
                    s = candidates.further[row, g, wp.max(m, 0)][k]
                    if s >= 0:
                        n = put_contact(obj, s, n, points, normals)
    return n


@wp.func
def _balanced(
    obj: Object, params: SearchValues, candidates: Candidates, tried: TriedSets, row: wp.int32, lane: wp.int32
):
    """True if friction balances a set."""
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    n = _contacts(obj, candidates, tried, row, lane, points, normals)
    centred(points, n, arms)
    return balances(arms, normals, n, params.friction * INSCRIBED, params.torque_scale, params.max_gswo)


@wp.kernel
def check_balance(hits: Hits, obj: Object, params: SearchValues, candidates: Candidates, tried_out: TriedSets):
    """Scores of hits go below 0 when friction does not balance them."""
    for i in range(wp.tid(), hits.number[0], hits.stride):
        row, lane = hit_at(hits, tried_out, i)
        if row >= 0 and not _balanced(obj, params, candidates, tried_out, row, lane):
            tried_out.score[row, lane] = -1.0


@wp.func
def _resists(
    obj: Object,
    params: SearchValues,
    candidates: Candidates,
    tried: TriedSets,
    row: wp.int32,
    lane: wp.int32,
    rank: wp.int32,
):
    """True if a set holds the object against the load of a rank, from the hardest, 0."""
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    n = _contacts(obj, candidates, tried, row, lane, points, normals)
    for c in range(n):
        points[c] = points[c] - obj.com
    turn = wp.quat_inverse(wp.transform_get_rotation(candidates.poses.pose[row]))
    limit = params.max_unresisted_load
    direction = by_difficulty(normals, n, params.friction, turn, rank)
    return unresisted(points, normals, n, params.friction, turn, direction, limit, limit) <= limit


@wp.kernel
def check_load(
    hits: Hits, obj: Object, params: SearchValues, first: wp.int32, candidates: Candidates, tried_out: TriedSets
):
    """One thread per (hit, direction): scores go below 0 when the set lets go of the object.

    Args:
        first: of the directions that are tried, from the hardest, 0.
    """
    at, rank = wp.tid()
    for i in range(at, hits.number[0], hits.stride):
        row, lane = hit_at(hits, tried_out, i)
        if row >= 0 and not _resists(obj, params, candidates, tried_out, row, lane, first + rank):
            tried_out.score[row, lane] = -1.0


@wp.kernel
def give_up(tried: TriedSets, usable_out: Usable):
    """Poses of which no set stands are left alone by later starts: their (pose, group) has no candidate to combine."""
    row, g = wp.tid()
    for lane in range(tried.score.shape[1]):
        if tried.score[row, lane] >= 0.0:
            return
    usable_out.size[row, g] = 0


@wp.func
def _fingers_apart(
    hand: Hand,
    params: SearchValues,
    candidates: Candidates,
    tried: TriedSets,
    row: wp.int32,
    lane: wp.int32,
    g: wp.int32,
    h: wp.int32,
):
    """True if fingers g < h of a set do not meet."""
    Xa = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Xb = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    group_forward(hand.kin, g, candidates.q[row, g, tried.chosen[row, lane, g]], Xa, 0)
    group_forward(hand.kin, h, candidates.q[row, h, tried.chosen[row, lane, h]], Xb, 0)
    return group_pairs_clear(hand, g + 1, h + 1, Xa, 0, Xb, 0, params.min_self_distance)


@wp.kernel
def check_fingers(hits: Hits, hand: Hand, params: SearchValues, candidates: Candidates, tried_out: TriedSets):
    """One thread per (finger, finger, hit): scores of hits go below 0 when two fingers meet."""
    g, h, at = wp.tid()
    if h <= g:
        return
    for i in range(at, hits.number[0], hits.stride):
        row, lane = hit_at(hits, tried_out, i)
        there = row >= 0 and tried_out.chosen[row, lane, g] >= 0 and tried_out.chosen[row, lane, h] >= 0
        if there and not _fingers_apart(hand, params, candidates, tried_out, row, lane, g, h):
            tried_out.score[row, lane] = -1.0


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
    """True if found set r has the same fingers as the tried one, and all their joints within ``separation``."""
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
def keep_sets(params: SearchValues, candidates: Candidates, tried: TriedSets, found_out: FoundSets):
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
    upto: wp.array(dtype=wp.int32),
    candidates: Candidates,
    slot: wp.int32,
    found: FoundSets,
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

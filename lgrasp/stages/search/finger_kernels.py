"""Kernels of the search stage that find fingers of hits which the filter would refuse, looking at each once."""

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.check_structs import Limits
from lgrasp.grasp.collision import body_depth_slice
from lgrasp.grasp.control_kernels import back_off, shift_contact
from lgrasp.grasp.held import Held
from lgrasp.grasp.pregrasp_kernels import FINGER_TRIES, distance_off, finger_clear, joint_motion, opened_finger
from lgrasp.grasp.structs import FURTHER, Candidates, further_contacts
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.kinematics import group_forward
from lgrasp.math.limits import MAX_BODIES, MAX_CONTACTS, MAX_JOINTS
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.search.kernels import hit_at
from lgrasp.stages.search.sets import AskedCandidates, Hits, TriedSets, Usable

wp.set_module_options(KERNEL_OPTIONS)

UNKNOWN = wp.constant(-1)
"""Nobody has looked at a candidate yet."""
_FIT, _UNFIT = wp.constant(0), wp.constant(1)


@wp.kernel
def list_fingers(hits: Hits, tried: TriedSets, usable_out: Usable, asked_out: AskedCandidates):
    """One thread per (group, hit): candidates that nobody has looked at, which are fit until something is found; their
    number is zero on entry."""
    g, at = wp.tid()
    for i in range(at, hits.number[0], hits.stride):
        row, lane = hit_at(hits, tried, i)
        if row >= 0:
            m = tried.chosen[row, lane, g]
            if m >= 0 and wp.atomic_max(usable_out.unfit, row, g, wp.max(m, 0), _FIT) == UNKNOWN:
                shape = usable_out.unfit.shape
                asked_out.place[wp.atomic_add(asked_out.number, 0, 1)] = (row * shape[1] + g) * shape[2] + m


@wp.kernel
def list_candidates(usable: Usable, asked_out: AskedCandidates):
    """One thread per (pose, group): the usable candidates; their number is zero on entry."""
    row, g = wp.tid()
    shape = usable.unfit.shape
    n = usable.size[row, g]
    if n > 0:
        at = wp.atomic_add(asked_out.number, 0, n)
        for k in range(n):
            asked_out.place[at + k] = (row * shape[1] + g) * shape[2] + usable.candidate[row, g, k]


@wp.func
def _asked_at(asked: AskedCandidates, candidates: Candidates, i: wp.int32):
    """Row, group and candidate of one that is listed."""
    slots = candidates.state.shape[2]
    groups = candidates.state.shape[1]
    place = asked.place[i]
    return place // (groups * slots), (place // slots) % groups, place % slots


@wp.func
def _body_sinks(
    hand: Hand,
    obj: Object,
    limit: wp.float32,
    candidates: Candidates,
    row: wp.int32,
    g: wp.int32,
    m: wp.int32,
    j: wp.int32,
    k: wp.int32,
    slices: wp.int32,
):
    """True if body j of a finger is in the object by more than ``limit`` [m] in slice k of its points."""
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = group_forward(hand.kin, g, candidates.q[row, g, m], X, 0)
    T = wp.transform_inverse(candidates.poses.pose[row]) * X[j]
    return body_depth_slice(hand, obj, 1 + j0 + j, T, limit, k, slices) > limit


@wp.func
def _met(
    hand: Hand,
    candidates: Candidates,
    usable: Usable,
    margin: wp.float32,
    row: wp.int32,
    g: wp.int32,
    m: wp.int32,
    h: wp.int32,
):
    """Bit k: a finger g < h meets finger h in its candidate k, or comes nearer than ``margin`` [m]."""
    Xa = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Xb = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    group_forward(hand.kin, g, candidates.q[row, g, m], Xa, 0)
    bits = wp.uint32(0)
    for i in range(usable.size[row, h]):
        k = usable.candidate[row, h, i]
        group_forward(hand.kin, h, candidates.q[row, h, k], Xb, 0)
        if not group_pairs_clear(hand, g + 1, h + 1, Xa, 0, Xb, 0, margin):
            bits = bits | (wp.uint32(1) << wp.uint32(k))
    return bits


@wp.kernel
def find_clashes(asked: AskedCandidates, hand: Hand, limits: Limits, candidates: Candidates, usable_out: Usable):
    """One thread per (finger, candidate listed): which postures of the two fingers meet; ``clash`` is zero on entry."""
    h, at = wp.tid()
    for i in range(at, asked.number[0], asked.stride):
        row, g, m = _asked_at(asked, candidates, i)
        if h > g and usable_out.size[row, h] > 0:
            bits = _met(hand, candidates, usable_out, limits.min_self_distance, row, g, m, h)
            usable_out.clash[row, g, m, h] = bits
            for k in range(usable_out.unfit.shape[2]):
                if ((bits >> wp.uint32(k)) & wp.uint32(1)) == wp.uint32(1):
                    wp.atomic_or(usable_out.clash, row, h, k, g, wp.uint32(1) << wp.uint32(m))


@wp.kernel
def find_sunk(
    asked: AskedCandidates,
    hand: Hand,
    obj: Object,
    limits: Limits,
    candidates: Candidates,
    slices: wp.int32,
    usable_out: Usable,
):
    """One thread per (slice, body of a finger, candidate listed), so that neighbours do like work: fingers that sink
    into the object with a body, at any point, as the filter would find.

    Args:
        slices: of the points of a body (:func:`~lgrasp.grasp.collision.depth_slices`).
    """
    k, j, at = wp.tid()
    for i in range(at, asked.number[0], asked.stride):
        row, g, m = _asked_at(asked, candidates, i)
        there = j < hand.kin.joint_first[g + 1] - hand.kin.joint_first[g] and usable_out.unfit[row, g, m] == _FIT
        if there and _body_sinks(hand, obj, limits.max_penetration, candidates, row, g, m, j, k, slices):
            usable_out.unfit[row, g, m] = _UNFIT


@wp.func
def _opens(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    limits: Limits,
    candidates: Candidates,
    row: wp.int32,
    g: wp.int32,
    m: wp.int32,
):
    """True if a finger by itself can come off the object, as far as ``min_pregrasp_opening`` and
    ``max_closing_travel`` ask."""
    q = candidates.q[row, g, m]
    pose = candidates.poses.pose[row]
    h = candidates.poses.index[row] // held.tries
    first = hand.kin.joint_first[g]
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    X_grasp = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    group_forward(hand.kin, g, q, X_grasp, first)
    touching = int(0)
    body = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.int32)
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    n = int(0)
    for f in range(1 + further_contacts(candidates, row, g, m)):
        place = field.point[candidates.record[row, g, m]]
        s = candidates.surface[row, g, m]
        if f > 0:
            place = candidates.further[row, g, m][FURTHER + f - 1]
            s = candidates.further[row, g, m][f - 1]
        body[n] = hand.contacts.body[place] - 1 - first
        touching = touching | (1 << body[n])
        p = wp.transform_point(pose, obj.contact_points[s])
        points[n] = wp.transform_point(wp.transform_inverse(X_grasp[first + body[n]]), p)
        normals[n] = wp.transform_vector(pose, obj.contact_normals[s])
        n += 1
    opened = shift_contact(hand, g, q, body[0], points[0], normals[0] * limits.pregrasp_distance)
    freed = q
    if n > 1:
        freed = back_off(hand, g, q, n, body, points, normals, limits.pregrasp_distance)
    off = wp.zeros(shape=(MAX_BODIES,), dtype=wp.float32)
    for k in range(first, hand.kin.joint_first[g + 1]):
        off[k] = limits.min_pregrasp_distance
        if (touching >> (k - first)) & 1 == 0:
            off[k] = distance_off(hand, obj, limits, 1 + k, wp.transform_inverse(pose) * X_grasp[k])
    for t in range(FINGER_TRIES):
        x = opened_finger(hand, held, h, g, t, q, opened, freed)
        moved = joint_motion(hand, g, x, q)
        if moved >= limits.min_pregrasp_opening:
            group_forward(hand.kin, g, x, X, first)
            resting = candidates.poses.resting[row]
            if finger_clear(hand, obj, held, limits, h, g, pose, resting, X, off) == 1:
                return moved <= limits.max_closing_travel
    return False


@wp.kernel
def find_stuck(
    asked: AskedCandidates,
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    limits: Limits,
    candidates: Candidates,
    usable_out: Usable,
):
    """One thread per candidate listed: fingers that cannot open, or would have to close from too far, as the filter
    would find of most."""
    for i in range(wp.tid(), asked.number[0], asked.stride):
        row, g, m = _asked_at(asked, candidates, i)
        fit = usable_out.unfit[row, g, m] == _FIT
        if fit and not _opens(hand, field, obj, held, limits, candidates, row, g, m):
            usable_out.unfit[row, g, m] = _UNFIT


@wp.kernel
def check_fit(hits: Hits, usable: Usable, tried_out: TriedSets):
    """Scores of hits go below 0 when one of their fingers is unfit."""
    for i in range(wp.tid(), hits.number[0], hits.stride):
        row, lane = hit_at(hits, tried_out, i)
        if row >= 0:
            for g in range(tried_out.chosen.shape[2]):
                m = tried_out.chosen[row, lane, g]
                if m >= 0 and usable.unfit[row, g, wp.max(m, 0)] == _UNFIT:
                    tried_out.score[row, lane] = -1.0


@wp.kernel
def drop_unfit(usable_out: Usable):
    """Candidates that were found to be unfit leave the lists of (pose, group)."""
    row, g = wp.tid()
    n = int(0)
    for k in range(usable_out.size[row, g]):
        m = usable_out.candidate[row, g, k]
        if usable_out.unfit[row, g, m] != _UNFIT:
            usable_out.candidate[row, g, n] = m
            n += 1
    usable_out.size[row, g] = n

"""Kernels of the checks: contacts on the links' true meshes, parts of the hand apart, penetration, rows that pass."""

import warp as wp

from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places
from lgrasp.grasp.collision import body_depth_slice, objects_apart
from lgrasp.grasp.held import Held, body_depth_in_held, group_fixed
from lgrasp.grasp.outcomes import Outcome
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear, overlap_depth
from lgrasp.math.kinematics import group_dofs, group_forward
from lgrasp.math.triangles import least_facing
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

TOUCHING, OTHERS, ALL = wp.constant(0), wp.constant(1), wp.constant(2)
"""Parts of a hand: base and touching fingers, fingers without contact, everything."""

_EDGE_TOLERANCE = wp.constant(3.0e-5)  # [m] beside an edge, within which any of its facets may be the nearest
_MESH_REACH = wp.constant(0.05)  # [m]
_TOO_NEAR_PENETRATION = wp.constant(1.0)  # [m] penetration reported for an object too near to a held one


@wp.func
def hand_pairs_clear(hand: Hand, a: wp.int32, b: wp.int32, X: wp.array(dtype=wp.transform), margin: wp.float32):
    """Pairs of two groups (0 = base, g + 1 = group g) of a whole hand, X[j] = pose of body 1 + j."""
    first = wp.min(a, b)
    last = wp.max(a, b)
    at = int(0)
    if first > 0:
        at = hand.kin.joint_first[first - 1]
    return group_pairs_clear(hand, first, last, X, at, X, hand.kin.joint_first[last - 1], margin)


@wp.func
def contact_fit(hand: Hand, grid: wp.int32, B: wp.transform, p: wp.vec3, inward: wp.vec3):
    """Distance [m] of a point from a link's mesh, and cosines of the direction into the object and its normals there.

    Args:
        B: pose of the link's body. p, inward: point and direction in that pose's outer frame.

    Returns:
        (distance, cosine at the nearest facet, least cosine of all facets that rounding may call the nearest).
    """
    local = wp.transform_point(wp.transform_inverse(B), p)
    mesh = hand.contacts.mesh[grid]
    hit = wp.mesh_query_point_no_sign(mesh, local, _MESH_REACH)
    out = wp.vec3(1.0, -1.0, 1.0)
    if hit.result:
        out[0] = wp.length(local - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v))
        out[1] = wp.dot(inward, wp.transform_vector(B, wp.mesh_eval_face_normal(mesh, hit.face)))
        # beside an edge rounding decides which facet is nearest, so all of them must do
        turned = wp.transform_vector(wp.transform_inverse(B), inward)
        out[2] = least_facing(mesh, local, out[0] + _EDGE_TOLERANCE, turned)
    return out


@wp.func
def fit_contacts(hand: Hand, places: Places, at: CheckedPostures, i: wp.int32):
    """Of all contacts of a hand whose bodies are placed: largest distance and least cosines of :func:`contact_fit`."""
    T = at.pose[at.of[i]]
    worst = wp.vec3(0.0, 1.0, 1.0)
    for k in range(at.contact.shape[1]):
        c = at.contact[i, k]
        if c >= 0 and places.grid[wp.max(c, 0)] >= 0:
            B = wp.transform_identity()
            if places.body[c] > 0:
                B = at.body[i, places.body[c] - 1]
            p = wp.transform_point(T, places.points[at.surface[i, k]])
            inward = -wp.transform_vector(T, places.normals[at.surface[i, k]])
            fit = contact_fit(hand, places.grid[c], B, p, inward)
            worst = wp.vec3(wp.max(worst[0], fit[0]), wp.min(worst[1], fit[1]), wp.min(worst[2], fit[2]))
    return worst


@wp.kernel
def check_postures(
    hand: Hand,
    held: Held,
    limits: Limits,
    places: Places,
    q: wp.array2d(dtype=wp.float32),
    at_out: CheckedPostures,
    found_out: Findings,
):
    """One thread per hand: its bodies, the fit of its contacts, and whether it is clear of itself.

    Reads pose, contact and surface of ``at_out``; writes the rest of it, and outcome, gap and facing of ``found_out``.

    Args:
        q: (n, K) joint positions [rad or m].
    """
    i = wp.tid()
    G = hand.kin.groups
    h = at_out.index[at_out.of[i]] // held.tries
    X = at_out.body[i]
    for g in range(G):
        x = group_dofs(hand.kin, g, q, i)
        at_out.posture[i, g] = x
        at_out.chosen[i, g] = -1
        group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
    touching = int(0)
    contacts = int(0)
    for k in range(at_out.contact.shape[1]):
        c = at_out.contact[i, k]
        if c >= 0:
            contacts += 1
            g = hand.body_group[places.body[c]]
            if g >= 0:
                at_out.chosen[i, g] = k
            else:
                touching = int(1)
    for g in range(G):
        if at_out.chosen[i, g] >= 0:
            touching += 1
    fit = fit_contacts(hand, places, at_out, i)
    found_out.gap[i] = fit[0]
    found_out.facing[i] = fit[1]
    outcome = int(Outcome.KEPT)
    few = touching < 2 or contacts < limits.min_contacts
    if few or fit[0] > limits.max_gap or wp.min(fit[1], fit[2]) < limits.min_cosine:
        outcome = Outcome.CONTACT
    for b in range(G):
        for a in range(b + 2):
            other = wp.max(a - 1, 0)
            fixed = group_fixed(hand, held, h, b) and (a == 0 or group_fixed(hand, held, h, other))
            if fixed or outcome != Outcome.KEPT:
                continue
            if not hand_pairs_clear(hand, a, b + 1, X, limits.min_self_distance):
                outcome = Outcome.SELF_COLLISION
    found_out.outcome[i] = outcome


@wp.kernel
def measure_penetration(
    hand: Hand,
    obj: Object,
    limits: Limits,
    part: wp.int32,
    slices: wp.int32,
    at: CheckedPostures,
    found_out: Findings,
):
    """Largest penetration [m] of a part of the hand (TOUCHING, OTHERS or ALL) and the object.

    One thread per (slice, body, hand), so that neighbours do like work; ``penetration`` grows to the largest, and above
    ``limits.deepest`` is just that.

    Args:
        slices: of the points of a body (:func:`~lgrasp.grasp.collision.depth_slices`).
    """
    k, b, i = wp.tid()
    if found_out.outcome[i] != Outcome.KEPT and limits.whole == 0:
        return
    if found_out.penetration[i] > limits.deepest:
        return
    g = hand.body_group[b]
    B = wp.transform_identity()
    if g < 0:
        if part == OTHERS:
            return
    else:
        if part != ALL and (at.chosen[i, g] >= 0) != (part == TOUCHING):
            return
        B = at.body[i, b - 1]
    T = wp.transform_inverse(at.pose[at.of[i]]) * B
    d = body_depth_slice(hand, obj, b, T, limits.deepest, k, slices)
    if d > 0.0:
        wp.atomic_max(found_out.penetration, i, d)


@wp.kernel
def measure_held_penetration(
    hand: Hand, obj: Object, held: Held, limits: Limits, at: CheckedPostures, found_out: Findings
):
    """Largest penetration [m] of what may move and the held objects, which the new object must keep apart from.

    One thread per (body, hand), the base's is that of the new object; ``penetration`` grows to the largest.
    """
    b, i = wp.tid()
    if found_out.outcome[i] != Outcome.KEPT or found_out.penetration[i] > limits.deepest:
        return
    row = at.of[i]
    h = at.index[row] // held.tries
    if b == 0:
        for k in range(held.objects):
            T = wp.transform_inverse(held.pose[h, k]) * at.pose[row]
            if not objects_apart(obj, held.object[k], T, limits.min_object_distance):
                wp.atomic_max(found_out.penetration, i, _TOO_NEAR_PENETRATION)
                return
        return
    if not group_fixed(hand, held, h, hand.body_group[b]):
        d = body_depth_in_held(hand, held, h, b, at.body[i, b - 1], limits.deepest)
        if d > 0.0:
            wp.atomic_max(found_out.penetration, i, d)


@wp.kernel
def count_outcomes(
    limits: Limits, found_out: Findings, kept_out: wp.array(dtype=wp.int32), counts_out: wp.array(dtype=wp.int32)
):
    """1 for hands that passed, the load included, (n,); ``counts_out`` grows by the hands of each outcome.

    Args:
        kept_out: (n,) 1 for hands that passed.
        counts_out: (reasons,) grows by the hands of each outcome.
    """
    i = wp.tid()
    if found_out.outcome[i] == Outcome.KEPT and found_out.unresisted_load[i] > limits.max_unresisted_load:
        found_out.outcome[i] = Outcome.UNRESISTED_LOAD
    kept_out[i] = wp.where(found_out.outcome[i] == Outcome.KEPT, 1, 0)
    wp.atomic_add(counts_out, found_out.outcome[i], 1)


@wp.kernel
def list_kept(found: Findings, upto: wp.array(dtype=wp.int32), row_out: wp.array(dtype=wp.int32)):
    """The hands that passed, (n,), ``upto[i]`` of them among the first ``i + 1``.

    Args:
        upto: (n,) hands that passed among the first i + 1.
        row_out: (n,) the hands that passed, first.
    """
    i = wp.tid()
    if found.outcome[i] == Outcome.KEPT:
        row_out[upto[i] - 1] = i


@wp.kernel
def pack_rows(
    hand: Hand, places: Places, at: CheckedPostures, found: Findings, row: wp.array(dtype=wp.int32), packed_out: Packed
):
    """Pose, contacts and numbers of the rows kept, and overlap of links that nearly always touch: others are apart.

    Args:
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    packed_out.pose[i] = at.pose[at.of[s]]
    packed_out.index[i] = at.index[at.of[s]]
    packed_out.slot[i] = at.slot[s]
    packed_out.self_penetration[i] = overlap_depth(hand, at.body, s)
    for k in range(found.numbers.shape[0]):
        packed_out.numbers[k, i] = found.numbers[k, s]
    for k in range(at.contact.shape[1]):
        c = at.contact[s, k]
        if c >= 0:
            packed_out.contact_points[i, k] = places.points[at.surface[s, k]]
            packed_out.contact_normals[i, k] = places.normals[at.surface[s, k]]
            packed_out.contact_links[i, k] = places.link[c]
            packed_out.contact_forces[i, k] = found.force[s, k]
        else:
            none = wp.vec3(wp.nan, wp.nan, wp.nan)
            packed_out.contact_points[i, k] = none
            packed_out.contact_normals[i, k] = none
            packed_out.contact_forces[i, k] = none
            packed_out.contact_links[i, k] = -1

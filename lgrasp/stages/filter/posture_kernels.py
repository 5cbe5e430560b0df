"""Kernels that put the hand into a set's posture: touching fingers first, the others after."""

import warp as wp

from lgrasp.field.arrays import Field, field_seed
from lgrasp.grasp.check_kernels import fit_contacts, hand_pairs_clear
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Places
from lgrasp.grasp.collision import body_clear, body_height, resting_plane
from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.structs import FURTHER, vec_further
from lgrasp.hand.arrays import Hand, thumb_placed
from lgrasp.math.kinematics import clamp_dofs, group_forward, vec_dof
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class SetCandidates:
    """Candidates that sets choose from: P poses, groups G, M candidates of each."""

    palm_point: wp.array(dtype=wp.int32)  # (P,) place on the hand that touches without a finger, -1 none
    palm_surface: wp.array(dtype=wp.int32)  # (P,) place on the object
    setting: wp.array(dtype=wp.int32)  # (P,) setting of the hand's shared joints
    surface: wp.array3d(dtype=wp.int32)  # (P, G, M) place on the object
    record: wp.array3d(dtype=wp.int32)  # (P, G, M) record of the field
    q: wp.array3d(dtype=vec_dof)  # (P, G, M) [rad or m]
    further: wp.array3d(dtype=vec_further)  # (P, G, M) contacts of other links of the finger; or (0, 0, 0)


@wp.kernel
def open_hands(hand: Hand, sets: SetCandidates, at_out: CheckedPostures):
    """Every finger open, as the setting of the set's pose has it."""
    i = wp.tid()
    for g in range(hand.kin.groups):
        first = hand.kin.dof_first[g]
        x = vec_dof()
        for d in range(hand.kin.dof_first[g + 1] - first):
            x[d] = hand.kin.dof_setting[sets.setting[at_out.of[i]], first + d]
        at_out.posture[i, g] = x


@wp.kernel
def place_touching(
    hand: Hand,
    field: Field,
    held: Held,
    limits: Limits,
    places: Places,
    sets: SetCandidates,
    least: wp.int32,
    at_out: CheckedPostures,
    found_out: Findings,
):
    """Postures and bodies of the touching fingers; contacts on the links' true meshes; collisions among these fingers.

    Contacts come in group order, that of the palm (or of a finger that stays as it is) after them, then those of other
    links; unused places hold -1.

    Args:
        least: contacts that a set must have.
    """
    i = wp.tid()
    row = at_out.of[i]
    h = at_out.index[row] // held.tries
    G = hand.kin.groups
    X = at_out.body[i]
    for g in range(G):
        if group_fixed(hand, held, h, g):
            at_out.posture[i, g] = held.posture[h, g]
            group_forward(hand.kin, g, held.posture[h, g], X, hand.kin.joint_first[g])
    k = int(0)
    for slot in range(at_out.contact.shape[1]):
        at_out.contact[i, slot] = -1
        at_out.surface[i, slot] = -1
    for g in range(G + 1):
        s = int(-1)
        c = int(-1)
        if g == G:
            if sets.palm_point[row] >= 0:
                s = sets.palm_surface[row]
                c = sets.palm_point[row]
        elif at_out.chosen[i, g] >= 0:
            m = at_out.chosen[i, g]
            x = clamp_dofs(hand.kin, g, sets.q[row, g, m])
            at_out.posture[i, g] = x
            group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
            s = sets.surface[row, g, m]
            c = field.point[sets.record[row, g, m]]
        if s >= 0:
            at_out.contact[i, k] = c
            at_out.surface[i, k] = s
            k += 1
    if sets.further.shape[2] > 0:
        for f in range(FURTHER):
            for g in range(G):
                m = at_out.chosen[i, g]
                if m >= 0 and k < at_out.contact.shape[1]:
                    s = sets.further[row, g, wp.max(m, 0)][f]
                    if s >= 0:
                        at_out.contact[i, k] = sets.further[row, g, wp.max(m, 0)][FURTHER + f]
                        at_out.surface[i, k] = s
                        k += 1
    fit = fit_contacts(hand, places, at_out, i)
    found_out.gap[i] = fit[0]
    found_out.facing[i] = fit[1]
    if k < least or fit[0] > limits.max_gap or wp.min(fit[1], fit[2]) < limits.min_cosine:
        found_out.outcome[i] = Outcome.CONTACT
        return
    for g in range(G):
        if at_out.chosen[i, g] >= 0:
            clear = hand_pairs_clear(hand, 0, g + 1, X, limits.min_self_distance)
            for f in range(G):
                if clear and (f == g or (at_out.chosen[i, f] >= 0 and f < g) or group_fixed(hand, held, h, f)):
                    clear = hand_pairs_clear(hand, f + 1, g + 1, X, limits.min_self_distance)
            if not clear:
                found_out.outcome[i] = Outcome.SELF_COLLISION
                return
    found_out.outcome[i] = Outcome.KEPT


@wp.kernel
def fill_unused(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    limits: Limits,
    seed: wp.array(dtype=wp.int32),
    draws: wp.int32,
    sets: SetCandidates,
    at_out: CheckedPostures,
    found_out: Findings,
):
    """Postures of fingers without contact: random ones of the field, drawn ever closer to the open posture.

    A posture is taken when it is clear of the object, the table, the palm and the fingers placed before, and a thumb is
    where it has to be.

    Args:
        seed: (1,) random seed.
    """
    i = wp.tid()
    if found_out.outcome[i] != Outcome.KEPT:
        return
    if found_out.penetration[i] > limits.max_penetration:
        found_out.outcome[i] = Outcome.OBJECT_COLLISION
        return
    row = at_out.of[i]
    G = hand.kin.groups
    h = at_out.index[row] // held.tries
    state = wp.rand_init(seed[0], at_out.index[row] * 64 + at_out.slot[i])
    T_object = wp.transform_inverse(at_out.pose[row])
    plane = resting_plane(obj, at_out.pose[row], at_out.resting[row])
    above = limits.min_table_distance
    X = at_out.body[i]
    for g in range(G):
        if at_out.chosen[i, g] < 0 and not group_fixed(hand, held, h, g):
            slot = sets.setting[row] * G + g
            r0 = field.start[field.cell_first[slot] * 64]
            r1 = field.start[field.cell_first[slot + 1] * 64]
            first = hand.kin.dof_first[g]
            dofs = hand.kin.dof_first[g + 1] - first
            found = int(0)
            for t in range(draws):
                share = 1.0 - float(t + 1) / float(draws)
                x = vec_dof()
                for d in range(dofs):
                    x[d] = hand.kin.dof_setting[sets.setting[row], first + d]
                if r1 > r0:
                    r = r0 + wp.min(int(wp.randf(state) * float(r1 - r0)), r1 - r0 - 1)
                    drawn = field_seed(field, hand.kin, slot, r)
                    # the values of shared joints are the same in both
                    x = x + share * (drawn - x)
                x = with_frozen(hand, held, h, g, x)
                group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
                clear = int(thumb_placed(hand, g, X, hand.kin.joint_first[g]))
                for k in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
                    if clear == 1 and not body_clear(hand, obj, 1 + k, T_object * X[k], limits.allowed_penetration):
                        clear = 0
                    if clear == 1 and body_height(hand.pieces, 1 + k, X[k], plane, above) < above:
                        clear = 0
                if clear == 1 and not hand_pairs_clear(hand, 0, g + 1, X, limits.min_self_distance):
                    clear = 0
                if clear == 1 and not hand_pairs_clear(hand, g + 1, g + 1, X, limits.min_self_distance):
                    clear = 0
                for f in range(G):
                    # used fingers, those that stay, and unused ones that are placed already
                    there = f != g and (at_out.chosen[i, f] >= 0 or f < g or group_fixed(hand, held, h, f))
                    if there and clear == 1 and not hand_pairs_clear(hand, f + 1, g + 1, X, limits.min_self_distance):
                        clear = 0
                if clear == 1:
                    at_out.posture[i, g] = x
                    found = 1
                    break
            if found == 0:
                found_out.outcome[i] = Outcome.UNUSED_FINGER
                return


@wp.kernel
def tell_postures(
    hand: Hand, at: CheckedPostures, pose_out: wp.array(dtype=wp.transform), q_out: wp.array2d(dtype=wp.float32)
):
    """Hands as poses of the object and joint positions.

    Args:
        pose_out: (n,) T_hand_object.
        q_out: (n, K) [rad or m].
    """
    i = wp.tid()
    pose_out[i] = at.pose[at.of[i]]
    for g in range(hand.kin.groups):
        first = hand.kin.dof_first[g]
        for d in range(hand.kin.dof_first[g + 1] - first):
            q_out[i, hand.kin.dof_index[first + d]] = at.posture[i, g][d]


@wp.kernel
def take_contacts(
    hand: Hand,
    limits: Limits,
    places: Places,
    runs: PalmarRuns,
    run: wp.array2d(dtype=wp.int32),
    surface: wp.array2d(dtype=wp.int32),
    at_out: CheckedPostures,
    found_out: Findings,
):
    """Contacts that were found on the final postures join those that were chosen, one of each link.

    Args:
        run: (n, C) as of :func:`~lgrasp.grasp.contact_kernels.choose_contacts`, as the next.
        surface: (n, C) contact point of the object.
    """
    i = wp.tid()
    if found_out.outcome[i] != Outcome.KEPT:
        return
    width = at_out.contact.shape[1]
    n = int(0)
    for k in range(width):
        if at_out.contact[i, k] >= 0:
            n += 1
    for k in range(run.shape[1]):
        r = run[i, k]
        fresh = r >= 0 and n < width
        for c in range(n):
            if fresh and places.link[at_out.contact[i, c]] == runs.link[wp.max(r, 0)]:
                fresh = False
        if fresh:
            at_out.contact[i, n] = runs.place[r]
            at_out.surface[i, n] = surface[i, k]
            g = hand.body_group[runs.body[r]]
            if g >= 0 and at_out.chosen[i, wp.max(g, 0)] < 0:
                at_out.chosen[i, g] = n
            n += 1
    fit = fit_contacts(hand, places, at_out, i)
    found_out.gap[i] = fit[0]
    found_out.facing[i] = fit[1]
    if n < limits.min_contacts or fit[0] > limits.max_gap or wp.min(fit[1], fit[2]) < limits.min_cosine:
        found_out.outcome[i] = Outcome.CONTACT

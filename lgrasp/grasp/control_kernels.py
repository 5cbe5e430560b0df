"""Kernels of the control poses: the hand opened before the grasp, and joint targets that press."""

import warp as wp

from lgrasp.grasp.check_kernels import hand_pairs_clear
from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places
from lgrasp.grasp.collision import body_apart
from lgrasp.grasp.control import press_contact, shift_contact
from lgrasp.grasp.held import Held, body_clear_of_held
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import MAX_BODIES, clamp_dofs, group_forward, vec_dof
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_OPENING_SHARES = wp.constant(5)  # of the way open that are tried


@wp.kernel
def control_poses(
    hand: Hand,
    limits: Limits,
    places: Places,
    at: CheckedPostures,
    found: Findings,
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
    opened_out: wp.array2d(dtype=vec_dof),
):
    """One thread per (row kept, group): q, q that presses, and the posture with its first contact off the object.

    The squeeze presses with the balancing forces, ``squeeze_force`` [N] in all along the normals.

    Args:
        row: (m,) hand of each row, -1 none.
        opened_out: (m, G) [rad or m].
    """
    i, g = wp.tid()
    s = row[i]
    if s < 0:
        return
    x = at.posture[s, g]
    opened = x
    pressed = x
    contacts = int(0)
    j0 = hand.kin.joint_first[g]
    for k in range(at.contact.shape[1]):
        c = at.contact[s, k]
        if c >= 0:
            b = places.body[c]
            if b > j0 and b <= hand.kin.joint_first[g + 1]:
                T = at.pose[at.of[s]]
                p = wp.transform_point(T, places.points[at.surface[s, k]])
                f = wp.transform_vector(T, found.force[s, k]) * limits.squeeze_force
                target = press_contact(hand, g, x, b - 1 - j0, at.body[s], p, f, limits.squeeze_stiffness)
                if contacts == 0:
                    n = wp.transform_vector(T, places.normals[at.surface[s, k]])
                    local = wp.transform_point(wp.transform_inverse(at.body[s, b - 1]), p)
                    opened = shift_contact(hand, g, x, b - 1 - j0, local, n * limits.pregrasp_distance)
                    pressed = target
                else:
                    pressed = clamp_dofs(hand.kin, g, pressed + target - x)
                contacts += 1
    first = hand.kin.dof_first[g]
    for d in range(hand.kin.dof_first[g + 1] - first):
        column = hand.kin.dof_index[first + d]
        packed_out.q[i, column] = x[d]
        packed_out.q_squeeze[i, column] = pressed[d]
    opened_out[i, g] = opened


@wp.kernel
def open_poses(
    hand: Hand,
    obj: Object,
    held: Held,
    limits: Limits,
    at: CheckedPostures,
    opened: wp.array2d(dtype=vec_dof),
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
):
    """The touching fingers as far open as leaves them apart from the objects and the rest of the hand.

    Shares of the way from q to ``opened`` are tried from all of it down; q itself when none is clear.

    Args:
        opened: (m, G) [rad or m].
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    h = at.index[at.of[s]] // held.tries
    G = hand.kin.groups
    T_object = wp.transform_inverse(at.pose[at.of[s]])
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    share = float(1.0)
    for t in range(_OPENING_SHARES + 1):
        share = 1.0 - float(t) / float(_OPENING_SHARES)
        clear = int(1)
        for g in range(G):
            x = at.posture[s, g] + share * (opened[i, g] - at.posture[s, g])
            first = hand.kin.joint_first[g]
            group_forward(hand.kin, g, x, X, first)
            if at.chosen[s, g] >= 0:
                for k in range(first, hand.kin.joint_first[g + 1]):
                    if clear == 1 and not body_apart(hand, obj, 1 + k, T_object * X[k], limits.min_pregrasp_distance):
                        clear = 0
                    if clear == 1 and not body_clear_of_held(hand, held, h, 1 + k, X[k], limits.min_self_distance):
                        clear = 0
        for b in range(G):
            for a in range(b + 2):
                moves = wp.where(at.chosen[s, b] >= 0 or (a > 0 and at.chosen[s, wp.max(a - 1, 0)] >= 0), 1, 0)
                if clear * moves == 1 and not hand_pairs_clear(hand, a, b + 1, X, limits.min_self_distance):
                    clear = 0
        if clear == 1:
            break
    for g in range(G):
        first = hand.kin.dof_first[g]
        x = at.posture[s, g] + share * (opened[i, g] - at.posture[s, g])
        for d in range(hand.kin.dof_first[g + 1] - first):
            packed_out.q_pregrasp[i, hand.kin.dof_index[first + d]] = x[d]

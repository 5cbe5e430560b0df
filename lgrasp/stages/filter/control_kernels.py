"""Kernels of the control poses: the hand opened before the grasp, and joint targets that press."""

import warp as wp

from lgrasp.grasp.collision import body_apart
from lgrasp.grasp.control import press_contact, shift_contact
from lgrasp.grasp.held import Held, body_clear_of_held
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.kinematics import MAX_BODIES, group_forward, vec_dof
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_SHARES = wp.constant(5)  # of the way open that are tried


@wp.kernel
def control_poses(
    hand: Hand,
    obj: Object,
    open_distance: wp.float32,
    squeeze_force: wp.float32,
    stiffness: wp.float32,
    pose: wp.array(dtype=wp.transform),
    set_pose: wp.array(dtype=wp.int32),
    contact: wp.array2d(dtype=wp.int32),
    contact_surface: wp.array2d(dtype=wp.int32),
    force: wp.array2d(dtype=wp.vec3),
    body: wp.array2d(dtype=wp.transform),
    posture: wp.array2d(dtype=vec_dof),
    rows: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    q_out: wp.array2d(dtype=wp.float32),
    squeeze_out: wp.array2d(dtype=wp.float32),
    opened_out: wp.array2d(dtype=vec_dof),
):
    """One thread per (kept row, group): q, q that presses, and the posture with the contact moved off the object.

    The squeeze presses with the balancing forces, ``squeeze_force`` [N] in all along the normals.
    """
    i, g = wp.tid()
    if i >= rows[0]:
        return
    s = row[i]
    x = posture[s, g]
    opened = x
    pressed = x
    j0 = hand.kin.joint_first[g]
    for k in range(contact.shape[1]):
        c = contact[s, k]
        if c >= 0:
            b = hand.contacts.body[c]
            if b > j0 and b <= hand.kin.joint_first[g + 1]:
                T = pose[set_pose[s]]
                p = wp.transform_point(T, obj.contact_points[contact_surface[s, k]])
                n = wp.transform_vector(T, obj.contact_normals[contact_surface[s, k]])
                local = wp.transform_point(wp.transform_inverse(body[s, b - 1]), p)
                opened = shift_contact(hand, g, x, b - 1 - j0, local, n * open_distance)
                f = wp.transform_vector(T, force[s, k]) * squeeze_force
                pressed = press_contact(hand, g, x, b - 1 - j0, body[s], p, f, stiffness)
    first = hand.kin.dof_first[g]
    for d in range(hand.kin.dof_first[g + 1] - first):
        column = hand.kin.dof_index[first + d]
        q_out[i, column] = x[d]
        squeeze_out[i, column] = pressed[d]
    opened_out[i, g] = opened


@wp.kernel
def open_poses(
    hand: Hand,
    obj: Object,
    held: Held,
    margin: wp.float32,
    self_margin: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    set_pose: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    posture: wp.array2d(dtype=vec_dof),
    opened: wp.array2d(dtype=vec_dof),
    rows: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    pregrasp_out: wp.array2d(dtype=wp.float32),
):
    """The touching fingers as far open as leaves them apart from the objects and the rest of the hand by the margins.

    Shares of the way from q to ``opened`` are tried from all of it down; q itself when none is clear.
    """
    i = wp.tid()
    if i >= rows[0]:
        return
    s = row[i]
    h = index[set_pose[s]] // held.tries
    G = hand.kin.groups
    T_object = wp.transform_inverse(pose[set_pose[s]])
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    share = float(1.0)
    for t in range(_SHARES + 1):
        share = 1.0 - float(t) / float(_SHARES)
        clear = int(1)
        for g in range(G):
            x = posture[s, g] + share * (opened[i, g] - posture[s, g])
            first = hand.kin.joint_first[g]
            group_forward(hand.kin, g, x, X, first)
            if chosen[s, g] >= 0:
                for k in range(first, hand.kin.joint_first[g + 1]):
                    if clear == 1 and not body_apart(hand, obj, 1 + k, T_object * X[k], margin):
                        clear = 0
                    if clear == 1 and not body_clear_of_held(hand, held, h, 1 + k, X[k], self_margin):
                        clear = 0
        for b in range(G):
            for a in range(b + 2):
                at = int(0)
                moves = int(0)
                if chosen[s, b] >= 0:
                    moves = 1
                if a > 0:
                    at = hand.kin.joint_first[a - 1]
                    if chosen[s, a - 1] >= 0:
                        moves = 1
                to = hand.kin.joint_first[b]
                if clear * moves == 1 and not group_pairs_clear(hand, a, b + 1, X, at, X, to, self_margin):
                    clear = 0
        if clear == 1:
            break
    for g in range(G):
        first = hand.kin.dof_first[g]
        x = posture[s, g] + share * (opened[i, g] - posture[s, g])
        for d in range(hand.kin.dof_first[g + 1] - first):
            pregrasp_out[i, hand.kin.dof_index[first + d]] = x[d]

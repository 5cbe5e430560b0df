"""How hard joints of limited stiffness can squeeze before the object leaves sideways.

Contacts are springs of stiffness kappa; joints follow by J with stiffness k. G is the grasp matrix, f are the forces of
a squeeze of 1 N. Turning the object by a small w takes along the points where they press: their torque grows by -A w,

    A = sum_c (r_c . f_c) I - (r_c f_c^T + f_c r_c^T) / 2

Contacts that press towards each other turn it further. The squeeze F is stable while K + F A is positive definite; K is
the stiffness of joints and contacts against turns of the object, which is free to move:

    K6 = kappa G G^T - kappa^2 G J (k I + kappa J^T J)^-1 J^T G^T,   K = K_rr - K_rt K_tt^-1 K_tr
"""

import warp as wp

from lgrasp.grasp.check_structs import CheckedPostures, Findings, Limits, Packed, Places
from lgrasp.hand.arrays import Hand
from lgrasp.math.cholesky import mat_dof, solve_dofs
from lgrasp.math.constants import SLIDING_ARM
from lgrasp.math.kinematics import point_column, vec_dof
from lgrasp.math.limits import MAX_DOFS
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

CONTACT_STIFFNESS = wp.constant(2.0e4)
"""Stiffness of a contact [N/m]."""
MOST_SQUEEZE = wp.constant(1000.0)
"""Squeezes above are not distinguished [N]."""
_LEAST_TWIST = wp.constant(1.0e-3)  # what resists turns about the line of two contacts [N m/rad]
_TINY = wp.constant(1.0e-9)


@wp.func
def _wrench_of(r: wp.vec3, a: wp.vec3):
    """A force a at r, and its torque."""
    t = wp.cross(r, a)
    return wp.spatial_vector(a[0], a[1], a[2], t[0], t[1], t[2])


@wp.func
def _finger_gives(
    hand: Hand, limits: Limits, places: Places, at: CheckedPostures, s: wp.int32, g: wp.int32, centre: wp.vec3
):
    """What the joints of group g take away from the stiffness of its contacts, about ``centre``, (6, 6)."""
    T = at.pose[at.of[s]]
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]
    Q = mat_dof()
    B = wp.zeros(shape=(6,), dtype=vec_dof)
    touches = int(0)
    for c in range(at.contact.shape[1]):
        place = at.contact[s, c]
        if place >= 0:
            b = places.body[place]
            if b > j0 and b <= hand.kin.joint_first[g + 1]:
                touches = 1
                p = wp.transform_point(T, places.points[at.surface[s, c]])
                J = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
                a = b - 1 - j0
                while a >= 0:
                    d = hand.kin.joint_dof[j0 + a]
                    arm = wp.where(hand.kin.drive_prismatic[j0 + a] == 1, SLIDING_ARM, 1.0)
                    J[d] = J[d] + point_column(hand.kin, j0 + a, at.body[s, j0 + a], p) * arm
                    a = hand.kin.joint_parent[j0 + a]
                for d in range(dofs):
                    w = _wrench_of(p - centre, J[d])
                    for e in range(6):
                        B[e][d] += CONTACT_STIFFNESS * w[e]
                    for e in range(dofs):
                        Q[d, e] += CONTACT_STIFFNESS * wp.dot(J[d], J[e])
    gives = wp.spatial_matrix()
    if touches == 1:
        for e in range(6):
            x = solve_dofs(Q, B[e], dofs, limits.squeeze_stiffness, _TINY)
            for f in range(6):
                gives[f, e] = wp.dot(B[f], x)
    return gives


@wp.func
def _stable_force(K: wp.mat33, A: wp.mat33):
    """Largest F with K + F A positive definite."""
    turns = wp.mat33()
    stiffness = wp.vec3()
    wp.eig3(0.5 * (K + wp.transpose(K)), turns, stiffness)
    W = wp.mat33()
    for j in range(3):
        for i in range(3):
            W[i, j] = turns[i, j] / wp.sqrt(wp.max(stiffness[j], 0.0) + _LEAST_TWIST)
    pushes = wp.vec3()
    wp.eig3(-(wp.transpose(W) * A * W), turns, pushes)
    return 1.0 / wp.max(wp.max(pushes), 1.0 / MOST_SQUEEZE)


@wp.kernel
def find_stable_squeeze(
    hand: Hand,
    limits: Limits,
    places: Places,
    at: CheckedPostures,
    found: Findings,
    row: wp.array(dtype=wp.int32),
    packed_out: Packed,
):
    """One thread per row kept: normal forces together [N] at which the squeeze stops being stable.

    A joint that groups share counts for each as its own.

    Args:
        row: (m,) hand of each row, -1 none.
    """
    i = wp.tid()
    s = row[i]
    if s < 0:
        return
    T = at.pose[at.of[s]]
    centre = wp.vec3(0.0)
    contacts = float(0.0)
    for c in range(at.contact.shape[1]):
        if at.contact[s, c] >= 0:
            centre += wp.transform_point(T, places.points[at.surface[s, c]])
            contacts += 1.0
    centre = centre / wp.max(contacts, 1.0)
    K6 = wp.spatial_matrix()
    A = wp.mat33()
    for c in range(at.contact.shape[1]):
        if at.contact[s, c] >= 0:
            r = wp.transform_point(T, places.points[at.surface[s, c]]) - centre
            f = wp.transform_vector(T, found.force[s, c])
            A += wp.dot(r, f) * wp.identity(n=3, dtype=wp.float32) - 0.5 * (wp.outer(r, f) + wp.outer(f, r))
            for d in range(3):
                axis = wp.vec3(0.0)
                axis[d] = 1.0
                w = _wrench_of(r, axis)
                K6 += CONTACT_STIFFNESS * wp.outer(w, w)
    for g in range(hand.kin.groups):
        K6 -= _finger_gives(hand, limits, places, at, s, g, centre)
    K_tt, K_tr, K_rr = wp.mat33(), wp.mat33(), wp.mat33()
    for d in range(3):
        for e in range(3):
            K_tt[d, e] = K6[d, e]
            K_tr[d, e] = K6[d, 3 + e]
            K_rr[d, e] = K6[3 + d, 3 + e]
    K = K_rr - wp.transpose(K_tr) * wp.inverse(K_tt) * K_tr
    packed_out.stable_squeeze[i] = _stable_force(K, A)

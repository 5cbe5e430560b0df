"""Kernels that find the contacts of hands in a posture, check them, and make their control poses."""

import warp as wp

from lgrasp.grasp.collision import body_apart, body_depth
from lgrasp.grasp.control import press_contact, shift_contact
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear, overlap_depth
from lgrasp.math.kinematics import MAX_BODIES, MAX_JOINTS, group_dofs, group_forward, vec_dof
from lgrasp.math.qp import MAX_CONTACTS, balance, unresisted
from lgrasp.math.quality import epsilon_bound
from lgrasp.math.sdf import sdf_gradient, sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_NEAR = wp.constant(0.006)  # [m] to a contact point of the object
_SHARES = wp.constant(5)  # of the way open that are tried


@wp.func
def _whole(hand: Hand, q: wp.array2d(dtype=wp.float32), i: wp.int32, X: wp.array(dtype=wp.transform)):
    """Poses of all moving bodies of row i into X."""
    for g in range(hand.kin.groups):
        group_forward(hand.kin, g, group_dofs(hand.kin, g, q, i), X, hand.kin.joint_first[g])


@wp.func
def _pairs_clear(hand: Hand, X: wp.array(dtype=wp.transform), margin: wp.float32):
    """Are all parts of the hand that must stay apart beyond the margin?"""
    for b in range(hand.kin.groups):
        for a in range(b + 2):
            at = int(0)
            if a > 0:
                at = hand.kin.joint_first[a - 1]
            if not group_pairs_clear(hand, a, b + 1, X, at, X, hand.kin.joint_first[b], margin):
                return False
    return True


@wp.func
def _all_apart(hand: Hand, obj: Object, T_object: wp.transform, X: wp.array(dtype=wp.transform), margin: wp.float32):
    """Are all moving bodies farther than the margin from the object? T_object = T_object_base."""
    apart = int(1)
    for j in range(hand.body_group.shape[0] - 1):
        if apart == 1 and not body_apart(hand, obj, 1 + j, T_object * X[j], margin):
            apart = int(0)
    return apart == 1


@wp.kernel
def link_contacts(
    hand: Hand,
    obj: Object,
    palmar: wp.array(dtype=wp.vec3),
    palmar_normal: wp.array(dtype=wp.vec3),
    run_first: wp.array(dtype=wp.int32),
    run_body: wp.array(dtype=wp.int32),
    gap: wp.float32,
    cosine: wp.float32,
    smooth: wp.float32,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
    contact_out: wp.array2d(dtype=wp.int32),
    gap_out: wp.array2d(dtype=wp.float32),
    dot_out: wp.array2d(dtype=wp.float32),
    point_out: wp.array2d(dtype=wp.vec3),
    normal_out: wp.array2d(dtype=wp.vec3),
):
    """One thread per (run of palmar points of one link, row): the nearest that faces the object, -1 if none does.

    The contact on the object is the foot of the perpendicular; its normal is that of the contact point beside it.
    """
    s, i = wp.tid()
    contact_out[i, s] = -1
    T_object = wp.transform_inverse(pose[i])
    g = hand.body_group[run_body[s]]
    T = T_object
    if g >= 0:
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        first = group_forward(hand.kin, g, group_dofs(hand.kin, g, q, i), X, 0)
        T = T_object * X[run_body[s] - 1 - first]
    best = gap
    for c in range(run_first[s], run_first[s + 1]):
        p = wp.transform_point(T, palmar[c])
        d = wp.abs(sdf_value(obj.sdf, p))
        if d < best:
            e = sdf_gradient(obj.sdf, p)
            n = wp.vec3(e[0], e[1], e[2])
            if wp.dot(n, wp.transform_vector(T, palmar_normal[c])) < -cosine:
                best = d
                contact_out[i, s] = c
    c = contact_out[i, s]
    if c < 0:
        return
    p = wp.transform_point(T, palmar[c])
    e = sdf_gradient(obj.sdf, p)
    n = wp.vec3(e[0], e[1], e[2])
    foot = p - n * e[3]
    beside = int(-1)
    near = float(_NEAR)
    for k in range(obj.contacts):
        far = wp.length(obj.contact_points[k] - foot)
        if far < near:
            near = far
            beside = k
    contact_out[i, s] = -1
    if beside >= 0:
        m = obj.contact_normals[beside]
        facing = -wp.dot(m, wp.transform_vector(T, palmar_normal[c]))
        if wp.dot(m, n) > smooth and facing > cosine:
            contact_out[i, s] = c
            gap_out[i, s] = best
            dot_out[i, s] = facing
            point_out[i, s] = foot
            normal_out[i, s] = m


@wp.kernel
def choose_contacts(
    hand: Hand,
    run_body: wp.array(dtype=wp.int32),
    link_contact: wp.array2d(dtype=wp.int32),
    link_gap: wp.array2d(dtype=wp.float32),
    link_out: wp.array2d(dtype=wp.int32),
    groups_out: wp.array(dtype=wp.int32),
):
    """Runs whose contacts are kept, the nearest of each group (palm included) first, then the nearest of the others."""
    i = wp.tid()
    runs = link_contact.shape[1]
    taken = wp.zeros(shape=(64,), dtype=wp.int32)
    has = wp.zeros(shape=(16,), dtype=wp.int32)
    groups = int(0)
    for k in range(link_out.shape[1]):
        best = int(-1)
        least = float(1.0e30)
        for s in range(runs):
            if link_contact[i, s] >= 0 and taken[s] == 0:
                # a group without contact goes before all others
                worth = link_gap[i, s] + 1.0e3 * float(has[hand.body_group[run_body[s]] + 1])
                if worth < least:
                    least = worth
                    best = s
        link_out[i, k] = best
        if best >= 0:
            taken[best] = 1
            g = hand.body_group[run_body[best]] + 1
            groups += 1 - has[g]
            has[g] = 1
    groups_out[i] = groups


@wp.kernel
def deepen_rows(
    hand: Hand,
    obj: Object,
    max_depth: wp.float32,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
    depth_out: wp.array(dtype=wp.float32),
):
    """One thread per (body, row): ``depth_out`` grows to the largest penetration [m]; above ``max_depth`` its value is
    of no account."""
    b, i = wp.tid()
    if depth_out[i] > max_depth:
        return
    B = wp.transform_identity()
    g = hand.body_group[b]
    if g >= 0:
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        first = group_forward(hand.kin, g, group_dofs(hand.kin, g, q, i), X, 0)
        B = X[b - 1 - first]
    d = body_depth(hand, obj, b, wp.transform_inverse(pose[i]) * B, max_depth)
    if d > 0.0:
        wp.atomic_max(depth_out, i, d)


@wp.kernel
def clear_of_itself(
    hand: Hand,
    margin: wp.float32,
    q: wp.array2d(dtype=wp.float32),
    body_out: wp.array2d(dtype=wp.transform),
    clear_out: wp.array(dtype=wp.int32),
    overlap_out: wp.array(dtype=wp.float32),
):
    """Is the hand clear of itself by the margin [m]? Also the poses of its bodies, and the overlap of pairs that nearly
    always touch."""
    i = wp.tid()
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    _whole(hand, q, i, X)
    clear_out[i] = wp.where(_pairs_clear(hand, X, margin), 1, 0)
    for j in range(body_out.shape[1]):
        body_out[i, j] = X[j]
    overlap_out[i] = overlap_depth(hand, body_out, i)


@wp.kernel
def balance_rows(
    obj: Object,
    seed: wp.int32,
    friction: wp.float32,
    torque_scale: wp.float32,
    pose: wp.array(dtype=wp.transform),
    link: wp.array2d(dtype=wp.int32),
    link_point: wp.array2d(dtype=wp.vec3),
    link_normal: wp.array2d(dtype=wp.vec3),
    force_out: wp.array2d(dtype=wp.vec3),
    number_out: wp.array2d(dtype=wp.float32),
):
    """FSWO, GSWO (8-edge cones) about the contacts' centroid, disturbance and epsilon about the centre of mass; forces
    of the round cone, in the object's frame."""
    i = wp.tid()
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = int(0)
    centroid = wp.vec3(0.0)
    for c in range(link.shape[1]):
        s = link[i, c]
        if s >= 0:
            points[k] = link_point[i, s] - obj.com
            normals[k] = -link_normal[i, s]
            centroid = centroid + points[k]
            k += 1
    if k < 2:
        number_out[0, i] = 1.0
        number_out[1, i] = 1.0
        number_out[2, i] = 1.0
        return
    for c in range(k):
        arms[c] = points[c] - centroid / float(k)
    number_out[0, i] = balance(arms, normals, k, 0.0, 0, torque_scale, 0.0, forces)
    number_out[1, i] = balance(arms, normals, k, friction, 8, torque_scale, 1.0e-4, forces)
    turn = wp.quat_inverse(wp.transform_get_rotation(pose[i]))
    worst = float(0.0)
    for direction in range(6):
        worst = wp.max(worst, unresisted(points, normals, k, friction, turn, direction, worst, 1.0))
    number_out[2, i] = worst
    number_out[3, i] = epsilon_bound(points, normals, k, friction, obj.radius, wp.rand_init(seed))
    for c in range(k):
        force_out[i, c] = forces[c]


@wp.kernel
def control_rows(
    hand: Hand,
    obj: Object,
    open_distance: wp.float32,
    open_margin: wp.float32,
    self_margin: wp.float32,
    squeeze_force: wp.float32,
    stiffness: wp.float32,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
    body: wp.array2d(dtype=wp.transform),
    link: wp.array2d(dtype=wp.int32),
    run_body: wp.array(dtype=wp.int32),
    link_point: wp.array2d(dtype=wp.vec3),
    link_normal: wp.array2d(dtype=wp.vec3),
    force: wp.array2d(dtype=wp.vec3),
    pregrasp_out: wp.array2d(dtype=wp.float32),
    squeeze_out: wp.array2d(dtype=wp.float32),
):
    """Targets that press with the balancing forces; fingers backed off their first contacts as far as is clear."""
    i = wp.tid()
    T = pose[i]
    for g in range(hand.kin.groups):
        x = group_dofs(hand.kin, g, q, i)
        opened = vec_dof(x)
        pressed = vec_dof(x)
        first = hand.kin.joint_first[g]
        moved = int(0)
        for k in range(link.shape[1]):
            s = link[i, k]
            if s >= 0:
                b = run_body[s]
                if hand.body_group[b] == g:
                    p = wp.transform_point(T, link_point[i, s])
                    n = wp.transform_vector(T, link_normal[i, s])
                    f = wp.transform_vector(T, force[i, k]) * squeeze_force
                    if moved == 0:
                        local = wp.transform_point(wp.transform_inverse(body[i, b - 1]), p)
                        opened = shift_contact(hand, g, x, b - 1 - first, local, n * open_distance)
                    moved = int(1)
                    pressed = pressed + press_contact(hand, g, x, b - 1 - first, body[i], p, f, stiffness) - x
        dof = hand.kin.dof_first[g]
        for d in range(hand.kin.dof_first[g + 1] - dof):
            column = hand.kin.dof_index[dof + d]
            if d < hand.kin.dof_free[g]:
                squeeze_out[i, column] = wp.clamp(pressed[d], hand.kin.dof_lower[dof + d], hand.kin.dof_upper[dof + d])
                pregrasp_out[i, column] = opened[d]
            else:
                squeeze_out[i, column] = x[d]
                pregrasp_out[i, column] = x[d]
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    T_object = wp.transform_inverse(T)
    share = float(1.0)
    for t in range(_SHARES + 1):
        share = 1.0 - float(t) / float(_SHARES)
        for g in range(hand.kin.groups):
            x = group_dofs(hand.kin, g, q, i)
            y = x + share * (group_dofs(hand.kin, g, pregrasp_out, i) - x)
            group_forward(hand.kin, g, y, X, hand.kin.joint_first[g])
        if _pairs_clear(hand, X, self_margin) and _all_apart(hand, obj, T_object, X, open_margin):
            break
    for column in range(q.shape[1]):
        pregrasp_out[i, column] = q[i, column] + share * (pregrasp_out[i, column] - q[i, column])

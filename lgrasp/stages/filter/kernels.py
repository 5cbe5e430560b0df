"""Kernel of the filter stage: completes the posture, then recomputes every claim about a grasp from its final q."""

import warp as wp

from lgrasp.device.kinematics import MAX_BODIES, MAX_DOFS, clamp_dofs, group_forward, point_column, vec_dof
from lgrasp.device.qp import MAX_CONTACTS, balance
from lgrasp.device.quality import epsilon_bound
from lgrasp.device.runtime import KERNEL_OPTIONS
from lgrasp.field.arrays import Field, field_seed
from lgrasp.grasp.clearance import body_clear, body_depth
from lgrasp.hand.arrays import Hand
from lgrasp.hand.clearance import group_pairs_clear
from lgrasp.object.arrays import Object

__all__ = ["METRICS", "REASONS", "finish_grasps"]

wp.set_module_options(KERNEL_OPTIONS)

REASONS = ("kept", "unused finger", "self-collision", "object collision", "contact", "balance")
"""Outcome codes of a set, in the order of the checks."""

METRICS = ("fswo", "gswo", "epsilon", "penetration", "self_penetration", "gap", "normal_error")
"""Columns of ``metrics_out``."""

mat_dof = wp.types.matrix((MAX_DOFS, MAX_DOFS), wp.float32)


@wp.func
def _group_clear_of_object(hand: Hand, obj: Object, g: wp.int32, X: wp.array(dtype=wp.transform), T_object: wp.transform, slack: wp.float32):
    for k in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
        if not body_clear(hand, obj, 1 + k, T_object * X[k], slack):
            return False
    return True


@wp.func
def _fill_unused(
    hand: Hand,
    field: Field,
    obj: Object,
    g: wp.int32,
    T_object: wp.transform,
    placed: wp.array(dtype=wp.int32),
    X: wp.array(dtype=wp.transform),
    draws: wp.int32,
    slack: wp.float32,
    margin: wp.float32,
    state: wp.uint32,
    q_out: wp.array(dtype=vec_dof),
):
    """Posture of an unused finger: random ones of the field, drawn ever closer to the open posture, until one is clear."""
    r0 = field.start[field.cell_first[g] * 64]
    r1 = field.start[field.cell_first[g + 1] * 64]
    first = hand.kin.dof_first[g]
    dofs = hand.kin.dof_first[g + 1] - first
    for t in range(draws):
        share = 1.0 - float(t + 1) / float(draws)
        q = vec_dof()
        if r1 > r0:
            q = field_seed(field, hand.kin, g, r0 + wp.min(int(wp.randf(state) * float(r1 - r0)), r1 - r0 - 1))
        for d in range(dofs):
            o = hand.kin.dof_open[first + d]
            q[d] = o + share * (q[d] - o)
        group_forward(hand.kin, g, q, X, hand.kin.joint_first[g])
        j = hand.kin.joint_first[g]
        if not _group_clear_of_object(hand, obj, g, X, T_object, slack):
            continue
        if not group_pairs_clear(hand, 0, g + 1, X, 0, X, j, margin):
            continue
        if not group_pairs_clear(hand, g + 1, g + 1, X, j, X, j, margin):
            continue
        clear = int(1)
        for h in range(hand.kin.groups):
            if clear == 1 and h != g and placed[h] == 1:
                a = wp.min(g, h)
                b = wp.max(g, h)
                if not group_pairs_clear(hand, a + 1, b + 1, X, hand.kin.joint_first[a], X, hand.kin.joint_first[b], margin):
                    clear = 0
        if clear == 1:
            q_out[g] = q
            return True
    return False


@wp.func
def _shift_contact(hand: Hand, g: wp.int32, q0: vec_dof, body: wp.int32, point: wp.vec3, by: wp.vec3):
    """Joint positions that move a body point of a group by ``by`` [m] (three damped least-squares steps), limits kept."""
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]
    q = q0
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    target = wp.vec3(0.0)
    for it in range(3):
        group_forward(hand.kin, g, q, X, 0)
        p = wp.transform_point(X[body], point)
        if it == 0:
            target = p + by
        e = target - p
        J = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
        j = body
        while j >= 0:
            d = hand.kin.joint_dof[j0 + j]
            J[d] = J[d] + point_column(hand.kin, j0 + j, X[j], p)
            j = hand.kin.joint_parent[j0 + j]
        # 3 x 3 normal equations of the damped right inverse: dq = J^T (J J^T + c I)^-1 e
        A = wp.identity(n=3, dtype=wp.float32) * 1.0e-4
        for a in range(dofs):
            A = A + wp.outer(J[a], J[a])
        y = wp.inverse(A) * e
        for a in range(dofs):
            q[a] = q[a] + wp.clamp(wp.dot(J[a], y), -0.4, 0.4)
        q = clamp_dofs(hand.kin, g, q)
    return q


@wp.kernel
def finish_grasps(
    hand: Hand,
    field: Field,
    obj: Object,
    seed: wp.int32,
    max_depth: wp.float32,
    margin: wp.float32,
    max_gap: wp.float32,
    cosine: wp.float32,
    friction: wp.float32,
    balanced: wp.float32,
    torque_scale: wp.float32,
    draws: wp.int32,
    slack: wp.float32,
    open_distance: wp.float32,
    press_distance: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    palm_point: wp.array(dtype=wp.int32),
    palm_surface: wp.array(dtype=wp.int32),
    surface: wp.array3d(dtype=wp.int32),
    record: wp.array3d(dtype=wp.int32),
    q: wp.array3d(dtype=vec_dof),
    set_pose: wp.array(dtype=wp.int32),
    set_slot: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    outcome_out: wp.array(dtype=wp.int32),
    q_out: wp.array2d(dtype=wp.float32),
    pregrasp_out: wp.array2d(dtype=wp.float32),
    squeeze_out: wp.array2d(dtype=wp.float32),
    point_out: wp.array2d(dtype=wp.vec3),
    normal_out: wp.array2d(dtype=wp.vec3),
    link_out: wp.array2d(dtype=wp.int32),
    force_out: wp.array2d(dtype=wp.vec3),
    metrics_out: wp.array2d(dtype=wp.float32),
):
    """One thread per contact set; ``outcome_out`` indexes REASONS and the other outputs hold for outcome 0 only."""
    i = wp.tid()
    row = set_pose[i]
    G = hand.kin.groups
    state = wp.rand_init(seed, index[row] * 64 + set_slot[i])
    T = pose[row]
    T_object = wp.transform_inverse(T)
    X = wp.zeros(shape=(MAX_BODIES,), dtype=wp.transform)
    placed = wp.zeros(shape=(8,), dtype=wp.int32)
    posture = wp.zeros(shape=(8,), dtype=vec_dof)
    # used fingers
    for g in range(G):
        if chosen[i, g] >= 0:
            posture[g] = clamp_dofs(hand.kin, g, q[row, g, chosen[i, g]])
            group_forward(hand.kin, g, posture[g], X, hand.kin.joint_first[g])
            placed[g] = 1
    for g in range(G):
        if placed[g] == 1:
            for h in range(g + 1):
                # h = 0 is the static base, else group h - 1
                if h == 0 or placed[h - 1] == 1:
                    at = int(0)
                    if h > 0:
                        at = hand.kin.joint_first[h - 1]
                    if not group_pairs_clear(hand, h, g + 1, X, at, X, hand.kin.joint_first[g], margin):
                        outcome_out[i] = 2
                        return
            if not group_pairs_clear(hand, g + 1, g + 1, X, hand.kin.joint_first[g], X, hand.kin.joint_first[g], margin):
                outcome_out[i] = 2
                return
    # contacts, on the true link surface
    k = int(0)
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    centroid = wp.vec3(0.0)
    worst_gap = float(0.0)
    worst_dot = float(1.0)
    for g in range(G + 1):
        s = int(-1)
        c = int(-1)
        B = wp.transform_identity()
        if g == G:
            if palm_point[row] >= 0:
                s = palm_surface[row]
                c = palm_point[row]
        elif chosen[i, g] >= 0:
            s = surface[row, g, chosen[i, g]]
            c = field.point[record[row, g, chosen[i, g]]]
            B = X[hand.contacts.body[c] - 1]
        if s >= 0:
            p = wp.transform_point(T, obj.contact_points[s])
            n = -wp.transform_vector(T, obj.contact_normals[s])
            local = wp.transform_point(wp.transform_inverse(B), p)
            mesh = hand.contacts.mesh[hand.contacts.grid[c]]
            hit = wp.mesh_query_point_no_sign(mesh, local, 0.05)
            gap = float(1.0)
            dot = float(-1.0)
            if hit.result:
                gap = wp.length(local - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v))
                dot = wp.dot(n, wp.transform_vector(B, wp.mesh_eval_face_normal(mesh, hit.face)))
            worst_gap = wp.max(worst_gap, gap)
            worst_dot = wp.min(worst_dot, dot)
            point_out[i, k] = obj.contact_points[s]
            normal_out[i, k] = obj.contact_normals[s]
            link_out[i, k] = hand.contacts.link[c]
            arms[k] = p
            normals[k] = n
            centroid = centroid + p
            k += 1
    if worst_gap > max_gap or worst_dot < cosine:
        outcome_out[i] = 4
        return
    # the object
    depth = float(0.0)
    for b in range(hand.kin.joint_first[G] + 1):
        B = wp.transform_identity()
        used = int(1)
        if b > 0:
            B = X[b - 1]
            used = int(0)
            for g in range(G):
                if b - 1 >= hand.kin.joint_first[g] and b - 1 < hand.kin.joint_first[g + 1]:
                    used = placed[g]
        if used == 1:
            depth = wp.max(depth, body_depth(hand, obj, b, T_object * B, max_depth))
            if depth > max_depth:
                outcome_out[i] = 3
                return
    # unused fingers
    for g in range(G):
        if chosen[i, g] < 0:
            if not _fill_unused(hand, field, obj, g, T_object, placed, X, draws, slack, margin, state, posture):
                outcome_out[i] = 1
                return
            placed[g] = 1
            for b in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
                depth = wp.max(depth, body_depth(hand, obj, 1 + b, T_object * X[b], max_depth))
            if depth > max_depth:
                outcome_out[i] = 3
                return
    # wrenches about the contact centroid
    centroid = centroid / float(k)
    for a in range(k):
        arms[a] = arms[a] - centroid
    fswo = balance(arms, normals, k, 0.0, 0, torque_scale, 0.0, forces)
    gswo = balance(arms, normals, k, friction, 8, torque_scale, 1.0e-4, forces)
    if gswo > balanced:
        outcome_out[i] = 5
        return
    for a in range(k):
        force_out[i, a] = wp.quat_rotate_inv(wp.transform_get_rotation(T), forces[a])
        arms[a] = arms[a] + centroid - wp.transform_point(T, obj.com)
    epsilon = epsilon_bound(arms, normals, k, friction, obj.radius, state)
    # control poses
    a = int(0)
    for g in range(G):
        opened = posture[g]
        pressed = posture[g]
        if chosen[i, g] >= 0:
            c = field.point[record[row, g, chosen[i, g]]]
            body = hand.contacts.body[c] - 1
            point = wp.transform_point(wp.transform_inverse(X[body]), arms[a] + wp.transform_point(T, obj.com))
            j = body - hand.kin.joint_first[g]
            opened = _shift_contact(hand, g, posture[g], j, point, -normals[a] * open_distance)
            pressed = _shift_contact(hand, g, posture[g], j, point, normals[a] * press_distance)
            a += 1
        first = hand.kin.dof_first[g]
        for d in range(hand.kin.dof_first[g + 1] - first):
            column = hand.kin.dof_index[first + d]
            q_out[i, column] = posture[g][d]
            pregrasp_out[i, column] = opened[d]
            squeeze_out[i, column] = pressed[d]
    metrics_out[i, 0] = fswo
    metrics_out[i, 1] = gswo
    metrics_out[i, 2] = epsilon
    metrics_out[i, 3] = depth
    metrics_out[i, 4] = 0.0
    metrics_out[i, 5] = worst_gap
    metrics_out[i, 6] = wp.acos(wp.clamp(worst_dot, -1.0, 1.0))
    outcome_out[i] = 0

"""Kernels of the ik stage: contacts are realised finger by finger; of sets the whole ones are kept."""

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.collision import body_clear
from lgrasp.grasp.held import Held, body_clear_of_held, group_fixed
from lgrasp.hand.arrays import Hand, hand_grid
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.kinematics import MAX_DOFS, MAX_JOINTS, clamp_dofs, group_forward, point_column, vec_dof
from lgrasp.math.sdf import sdf_gradient
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

mat_dof = wp.types.matrix((MAX_DOFS, MAX_DOFS), wp.float32)


@wp.func
def _solve(A: mat_dof, b: vec_dof, n: wp.int32):
    """x with A x = b for the leading n x n block, by Cholesky."""
    L = mat_dof()
    for i in range(n):
        for j in range(i + 1):
            s = A[i, j]
            for k in range(j):
                s -= L[i, k] * L[j, k]
            if i == j:
                L[i, i] = wp.sqrt(wp.max(s, 1.0e-12))
            else:
                L[i, j] = s / L[j, j]
    x = vec_dof()
    for i in range(n):
        s = b[i]
        for k in range(i):
            s -= L[i, k] * x[k]
        x[i] = s / L[i, i]
    for r in range(n):
        i = n - 1 - r
        s = x[i]
        for k in range(i + 1, n):
            s -= L[k, i] * x[k]
        x[i] = s / L[i, i]
    return x


@wp.kernel
def realise_contacts(
    hand: Hand,
    field: Field,
    obj: Object,
    iterations: wp.int32,
    lever: wp.float32,
    weight: wp.float32,
    damping: wp.float32,
    max_step: wp.float32,
    max_gap: wp.float32,
    touch: wp.float32,
    cosine: wp.float32,
    slack: wp.float32,
    clearance: wp.int32,
    tries: wp.int32,
    frozen: wp.array2d(dtype=wp.int32),
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    count: wp.array2d(dtype=wp.int32),
    surface: wp.array3d(dtype=wp.int32),
    record: wp.array3d(dtype=wp.int32),
    wanted: wp.array3d(dtype=wp.int32),
    q_out: wp.array3d(dtype=vec_dof),
    state_out: wp.array3d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """Joint positions that put a candidate's contact on the object (eq. 7), and whether they do.

    ``q_out`` holds the seed on entry; its ``frozen`` dofs do not move (:class:`Held`). Candidates with ``wanted`` 0 are
    left alone. ``counts_out`` grows by those tried,
    reached and kept.
    """
    row, g, m = wp.tid()
    if m >= count[row, g] or wanted[row, g, m] == 0:
        return
    T = pose[row]
    s = surface[row, g, m]
    target = wp.transform_point(T, obj.contact_points[s])
    normal = -wp.transform_vector(T, obj.contact_normals[s])
    c = field.point[record[row, g, m]]
    grid = hand.contacts.grid[c]
    sdf = hand_grid(hand.contacts, grid)
    j0 = hand.kin.joint_first[g]
    body = hand.contacts.body[c] - 1 - j0
    dofs = hand.kin.dof_free[g]
    still = frozen[index[row] // tries, g]
    q = q_out[row, g, m]
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    point = hand.contacts.points[c]
    out = hand.contacts.normals[c]
    gap = float(1.0)
    dot = float(0.0)
    w2 = weight * weight
    for it in range(iterations + 1):
        group_forward(hand.kin, g, q, X, 0)
        B = X[body]
        if it > 0:
            # the contact slides: nearest point of the link surface to the target
            local = wp.transform_point(wp.transform_inverse(B), target)
            e = sdf_gradient(sdf, local)
            out = wp.vec3(e[0], e[1], e[2])
            point = local - out * e[3]
            gap = e[3]
        n = wp.transform_vector(B, out)
        dot = wp.dot(n, normal)
        if it > 0 and wp.abs(gap + touch) < 0.25 * max_gap and dot > 0.5 * (1.0 + cosine):
            break
        if it == iterations:
            break
        p = wp.transform_point(B, point)
        e1 = target + normal * touch - p
        e2 = e1 + (normal - n) * lever
        A = mat_dof()
        b = vec_dof()
        J1 = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
        J2 = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
        j = body
        while j >= 0:
            d = hand.kin.joint_dof[j0 + j]
            J1[d] = J1[d] + point_column(hand.kin, j0 + j, X[j], p)
            J2[d] = J2[d] + point_column(hand.kin, j0 + j, X[j], p + n * lever)
            j = hand.kin.joint_parent[j0 + j]
        for a in range(dofs):
            if ((still >> a) & 1) == 1:
                J1[a] = wp.vec3(0.0)
                J2[a] = wp.vec3(0.0)
            b[a] = wp.dot(J1[a], e1) + w2 * wp.dot(J2[a], e2)
            for k in range(a + 1):
                A[a, k] = wp.dot(J1[a], J1[k]) + w2 * wp.dot(J2[a], J2[k])
            A[a, a] = A[a, a] + damping
        step = _solve(A, b, dofs)
        for a in range(dofs):
            q[a] = q[a] + wp.clamp(step[a], -max_step, max_step)
        q = clamp_dofs(hand.kin, g, q)
    ok = int(1)
    if wp.abs(gap + touch) > max_gap or dot < cosine:
        ok = -1
    if ok == 1:
        for r in range(hand.contacts.rule_first[grid], hand.contacts.rule_first[grid + 1]):
            f = hand.contacts.rules[r]
            if f[0] * out[0] + f[1] * out[1] + f[2] * out[2] > f[3]:
                ok = -1
    if ok == 1 and clearance == 1:
        T_object = wp.transform_inverse(T)
        # the touching body first: it fails most often
        joints = hand.kin.joint_first[g + 1] - j0
        for k in range(joints):
            j = (body + joints - k) % joints
            if ok == 1 and not body_clear(hand, obj, 1 + j0 + j, T_object * X[j], slack):
                ok = -2
    q_out[row, g, m] = q
    state_out[row, g, m] = ok
    wp.atomic_add(counts_out, 0, 1)
    if ok != -1:
        wp.atomic_add(counts_out, 1, 1)
    if ok == 1:
        wp.atomic_add(counts_out, 2, 1)


@wp.kernel
def avoid_held(
    hand: Hand,
    held: Held,
    margin: wp.float32,
    self_margin: wp.float32,
    index: wp.array(dtype=wp.int32),
    count: wp.array2d(dtype=wp.int32),
    q: wp.array3d(dtype=vec_dof),
    state_out: wp.array3d(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """Realised candidates whose finger meets a held object, or a finger that stays as it is, fail."""
    row, g, m = wp.tid()
    if m >= count[row, g] or state_out[row, g, m] != 1:
        return
    h = index[row] // held.tries
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    Y = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = group_forward(hand.kin, g, q[row, g, m], X, 0)
    ok = int(1)
    for j in range(hand.kin.joint_first[g + 1] - j0):
        if ok == 1 and not body_clear_of_held(hand, held, h, 1 + j0 + j, X[j], margin):
            ok = 0
    for f in range(hand.kin.groups):
        if ok == 1 and f != g and group_fixed(hand, held, h, f):
            group_forward(hand.kin, f, held.posture[h, f], Y, 0)
            if f < g:
                if not group_pairs_clear(hand, f + 1, g + 1, Y, 0, X, 0, self_margin):
                    ok = 0
            elif not group_pairs_clear(hand, g + 1, f + 1, X, 0, Y, 0, self_margin):
                ok = 0
    if ok == 0:
        state_out[row, g, m] = -2
        wp.atomic_sub(counts_out, 2, 1)


@wp.kernel
def mark_chosen(
    rows: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    wanted_out: wp.array3d(dtype=wp.int32),
):
    """1 at every candidate that a set has chosen."""
    i = wp.tid()
    if i >= rows[0]:
        return
    for g in range(chosen.shape[1]):
        if chosen[i, g] >= 0:
            wanted_out[pose[i], g, chosen[i, g]] = 1


@wp.kernel
def flag_realised(
    rows: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    state: wp.array3d(dtype=wp.int32),
    whole_out: wp.array(dtype=wp.int32),
):
    """1 for sets whose every contact was realised."""
    i = wp.tid()
    whole_out[i] = 0
    if i >= rows[0]:
        return
    for g in range(chosen.shape[1]):
        if chosen[i, g] >= 0 and state[pose[i], g, wp.max(chosen[i, g], 0)] != 1:
            return
    whole_out[i] = 1


@wp.kernel
def take_realised(
    upto: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.int32),
    slot: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    score: wp.array(dtype=wp.float32),
    pose_out: wp.array(dtype=wp.int32),
    slot_out: wp.array(dtype=wp.int32),
    chosen_out: wp.array2d(dtype=wp.int32),
    score_out: wp.array(dtype=wp.float32),
    rows_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """The whole sets, ``upto[s]`` of them among the first ``s + 1``."""
    s = wp.tid()
    if s == upto.shape[0] - 1:
        rows_out[0] = upto[s]
        counts_out[3] = upto[s]
    before = int(0)
    if s > 0:
        before = upto[s - 1]
    if upto[s] > before:
        pose_out[before] = pose[s]
        slot_out[before] = slot[s]
        score_out[before] = score[s]
        for g in range(chosen.shape[1]):
            chosen_out[before, g] = chosen[s, g]

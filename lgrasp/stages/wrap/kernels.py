"""Kernels of the wrap stage: further links of a finger are laid on the object, its first contact slides."""

from enum import IntEnum

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.collision import body_clear, body_far, finger_above, resting_plane
from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.held import Held, body_clear_of_held
from lgrasp.grasp.structs import FURTHER, Candidates, State, vec_further
from lgrasp.hand.arrays import Hand, thumb_placed
from lgrasp.math.cholesky import mat_dof, solve_dofs
from lgrasp.math.kinematics import clamp_dofs, group_forward, point_column, vec_dof
from lgrasp.math.limits import MAX_DOFS, MAX_JOINTS
from lgrasp.math.sdf import nearer, sdf_gradient
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.wrap.touch import LinkTouch, WrapValues, contact_beside, fits, nearest_touch, touches_there

wp.set_module_options(KERNEL_OPTIONS)

_LINKS = wp.constant(6)  # most links of a finger that are looked at
_WAITING, _ASKED, _FAILED = wp.constant(0), wp.constant(1), wp.constant(2)  # what a link is to do
_FACING = wp.constant(0.7)  # least cosine of normals of a link that may come to touch
_SLIDES = wp.constant(3)  # of touches where a posture is new; afterwards they slide with every step
_FARTHEST_STEP = wp.constant(0.006)  # [m] of a link towards the object
_OFF = wp.constant(0.0005)  # [m] that links without contact keep off the object
_LEVER = wp.constant(0.01)  # [m] from a contact along its normal to the point that turns it
_AT_LIMIT = wp.constant(1.0e-4)  # [rad or m]


class WrapCount(IntEnum):
    """Counts of the stage."""

    TRIED = 0
    WRAPPED = 1


@wp.func
def _nearest_probe(hand: Hand, obj: Object, runs: PalmarRuns, params: WrapValues, r: wp.int32, T: wp.transform):
    """The point of a run that is nearest to the object and faces it, as a touch; its run is -1 if none is in reach.

    T = T_object_body.
    """
    touch = LinkTouch()
    touch.run = -1
    if body_far(hand, obj, runs.body[r], T, params.reach):
        return touch
    touch.gap = params.reach
    for k in range(runs.first[r], runs.first[r + 1]):
        p = wp.transform_point(T, runs.points[k])
        gap = nearer(obj.sdf, p, touch.gap)
        if gap < touch.gap:
            e = sdf_gradient(obj.sdf, p)
            if wp.dot(wp.transform_vector(T, runs.normals[k]), wp.vec3(e[0], e[1], e[2])) < -_FACING:
                touch.run = r
                touch.gap = gap
                touch.local = runs.points[k]
                touch.out = runs.normals[k]
    return touch


@wp.func
def near_links(
    hand: Hand,
    obj: Object,
    runs: PalmarRuns,
    params: WrapValues,
    g: wp.int32,
    T_object: wp.transform,
    X: wp.array(dtype=wp.transform),
    touch: wp.array(dtype=LinkTouch),
):
    """Number of links of a finger that have a point in reach; writes its touch for each, as many as there is room for.

    X: its bodies, T_object = T_object_base.
    """
    n = int(0)
    for r in range(runs.body.shape[0]):
        body = runs.body[r]
        if hand.body_group[body] == g and runs.grid[r] >= 0 and n < touch.shape[0]:
            near = _nearest_probe(hand, obj, runs, params, r, T_object * X[body - 1 - hand.kin.joint_first[g]])
            if near.run >= 0:
                touch[n] = near
                n += 1
    return n


@wp.func
def next_link(
    runs: PalmarRuns, params: WrapValues, touch: wp.array(dtype=LinkTouch), task: wp.array(dtype=wp.int32), n: wp.int32
):
    """The nearest of the links that wait, on a body that no link asked to touch rides on; -1 if there is none."""
    near = params.reach
    added = int(-1)
    for i in range(n):
        if task[i] == _WAITING and touch[i].gap < near:
            alone = int(1)
            for o in range(n):
                if task[o] == _ASKED and runs.body[touch[o].run] == runs.body[touch[i].run]:
                    alone = 0
            if alone == 1:
                near = touch[i].gap
                added = i
    return added


@wp.func
def clear_of_all(
    hand: Hand,
    obj: Object,
    held: Held,
    params: WrapValues,
    h: wp.int32,
    g: wp.int32,
    pose: wp.transform,
    resting: wp.int32,
    X: wp.array(dtype=wp.transform),
):
    """True if a finger is off the object, what is held, and the table, and a thumb is where it has to be; X holds the
    poses of its bodies."""
    if not thumb_placed(hand, g, X, 0):
        return False
    j0 = hand.kin.joint_first[g]
    T_object = wp.transform_inverse(pose)
    for j in range(hand.kin.joint_first[g + 1] - j0):
        if not body_clear(hand, obj, 1 + j0 + j, T_object * X[j], params.allowed_penetration):
            return False
        if not body_clear_of_held(hand, held, h, 1 + j0 + j, X[j], params.min_self_distance):
            return False
    if obj.resting.count > 0:
        return finger_above(hand, g, X, resting_plane(obj, pose, resting), params.min_table_distance)
    return True


@wp.kernel
def list_realised(
    candidates_out: Candidates, listed_out: wp.array(dtype=wp.int32), counts_out: wp.array(dtype=wp.int32)
):
    """Realised candidates side by side, in any order; none of the candidates has further contacts yet.

    Args:
        listed_out: flat indices of (P, G, M), (P * G * M,).
        counts_out: WrapCount, (2,).
    """
    row, g, m = wp.tid()
    if m >= candidates_out.count[row, g]:
        return
    candidates_out.further[row, g, m] = vec_further(-1)
    if candidates_out.state[row, g, m] == State.REALISED:
        i = wp.atomic_add(counts_out, int(WrapCount.TRIED), 1)
        shape = candidates_out.state.shape
        listed_out[i] = (row * shape[1] + g) * shape[2] + m


@wp.func
def _add_rows(
    hand: Hand,
    g: wp.int32,
    params: WrapValues,
    pose: wp.transform,
    X: wp.array(dtype=wp.transform),
    body: wp.int32,
    touch: LinkTouch,
    asked: wp.bool,
    still: wp.int32,
    A: mat_dof,
    b: vec_dof,
):
    """The normal equations and the rows of one link: its distance, and its normal where it is asked to touch."""
    aim = _OFF - touch.gap
    weight = float(0.0)
    if asked:
        aim = -(touch.gap + params.contact_indentation)
        weight = params.normal_weight * params.normal_weight
    if not asked and aim < 0.0:
        return A, b
    aim = wp.clamp(aim, -_FARTHEST_STEP, _FARTHEST_STEP)
    j0 = hand.kin.joint_first[g]
    dofs = hand.kin.dof_free[g]
    p = wp.transform_point(X[body], touch.local)
    across = wp.transform_vector(pose, touch.normal)
    f = wp.transform_vector(X[body], touch.out)
    turn = -(f + across) * _LEVER
    J = vec_dof()
    R = wp.zeros(shape=(MAX_DOFS,), dtype=wp.vec3)
    j = body
    while j >= 0:
        d = hand.kin.joint_dof[j0 + j]
        moved = point_column(hand.kin, j0 + j, X[j], p)
        J[d] = J[d] + wp.dot(moved, across)
        R[d] = R[d] + point_column(hand.kin, j0 + j, X[j], p + f * _LEVER) - moved
        j = hand.kin.joint_parent[j0 + j]
    for a in range(MAX_DOFS):
        if a >= dofs or ((still >> a) & 1) == 1:
            J[a] = 0.0
            R[a] = wp.vec3(0.0)
        b[a] = b[a] + J[a] * aim + weight * wp.dot(R[a], turn)
        for k in range(a + 1):
            A[a, k] = A[a, k] + J[a] * J[k] + weight * wp.dot(R[a], R[k])
    return A, b


@wp.func
def _bounded_step(hand: Hand, g: wp.int32, q: vec_dof, params: WrapValues, A: mat_dof, b: vec_dof):
    """q after the damped least-squares step of the joints that it does not press against a limit."""
    first = hand.kin.dof_first[g]
    dofs = hand.kin.dof_free[g]
    M = A
    r = b
    for a in range(MAX_DOFS):
        M[a, a] = M[a, a] + params.damping
    step = solve_dofs(M, r, dofs, 0.0, 1.0e-12)
    stuck = int(0)
    for a in range(dofs):
        low = hand.kin.dof_lower[first + a]
        high = hand.kin.dof_upper[first + a]
        if (q[a] <= low + _AT_LIMIT and step[a] < 0.0) or (q[a] >= high - _AT_LIMIT and step[a] > 0.0):
            stuck += 1
            r[a] = 0.0
            for k in range(MAX_DOFS):
                if k < a:
                    M[a, k] = 0.0
                if k > a:
                    M[k, a] = 0.0
    if stuck > 0:
        step = solve_dofs(M, r, dofs, 0.0, 1.0e-12)
    moved = q
    for a in range(dofs):
        moved[a] = moved[a] + wp.clamp(step[a], -params.step, params.step)
    return clamp_dofs(hand.kin, g, moved)


@wp.func
def _ask_link(
    hand: Hand,
    obj: Object,
    runs: PalmarRuns,
    params: WrapValues,
    g: wp.int32,
    pose: wp.transform,
    still: wp.int32,
    start: vec_dof,
    touch: wp.array(dtype=LinkTouch),
    task: wp.array(dtype=wp.int32),
    n: wp.int32,
):
    """Whether the links that are asked to touch all do after a few steps from a posture, and that posture."""
    q = start
    j0 = hand.kin.joint_first[g]
    T_object = wp.transform_inverse(pose)
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    for it in range(params.iterations + 1):
        group_forward(hand.kin, g, q, X, 0)
        missing = int(0)
        A = mat_dof()
        b = vec_dof()
        for i in range(n):
            body = runs.body[touch[i].run] - 1 - j0
            touch[i] = nearest_touch(hand, obj, runs, T_object * X[body], touch[i], 2)
            if task[i] == _ASKED and not fits(hand, runs, params, T_object * X[body], touch[i]):
                missing += 1
            A, b = _add_rows(hand, g, params, pose, X, body, touch[i], task[i] == _ASKED, still, A, b)
        if missing == 0:
            return True, q
        if it < params.iterations:
            q = _bounded_step(hand, g, q, params, A, b)
    return False, q


@wp.kernel
def wrap_fingers(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    runs: PalmarRuns,
    params: WrapValues,
    listed: wp.array(dtype=wp.int32),
    candidates_out: Candidates,
    counts_out: wp.array(dtype=wp.int32),
):
    """Postures of realised candidates in which further links of the finger touch; others stay as they are.

    Link after link is asked to touch, the nearest first, with steps dq := argmin sum_l (n_l . J_l dq + g_l +
    indentation)^2 + w^2 |normals|^2 + damping |dq|^2 over those asked; g_l is the distance of link and object, n_l
    the object's normal there. Contacts, the first one too, are free to slide; other links are pushed off the
    object. ``surface`` and ``q`` of a candidate follow its first contact, ``further`` are the others. Candidates
    whose finger is not clear, or does not touch by its mesh, in either posture are blocked.

    Args:
        runs: points of links that may touch.
        listed: the realised candidates, (P * G * M,); WrapCount.TRIED of them are there.
        counts_out: WrapCount, (2,).
    """
    i = wp.tid()
    if i >= counts_out[int(WrapCount.TRIED)]:
        return
    slots = candidates_out.state.shape[2]
    row = listed[i] // (candidates_out.state.shape[1] * slots)
    g = (listed[i] // slots) % candidates_out.state.shape[1]
    m = listed[i] % slots
    pose = candidates_out.poses.pose[row]
    resting = candidates_out.poses.resting[row]
    T_object = wp.transform_inverse(pose)
    h = candidates_out.poses.index[row] // held.tries
    own = hand.contacts.link[field.point[candidates_out.record[row, g, m]]]
    j0 = hand.kin.joint_first[g]
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    touch = wp.zeros(shape=(_LINKS,), dtype=LinkTouch)
    found = wp.zeros(shape=(_LINKS,), dtype=LinkTouch)
    task = wp.zeros(shape=(_LINKS,), dtype=wp.int32)
    posture = candidates_out.q[row, g, m]
    group_forward(hand.kin, g, posture, X, 0)
    n = near_links(hand, obj, runs, params, g, T_object, X, touch)
    first = int(-1)
    for i in range(n):
        task[i] = _WAITING
        if runs.link[touch[i].run] == own:
            first = i
            task[i] = _ASKED
    made = int(0)
    for _round in range(wp.where(first < 0, 0, params.rounds)):
        group_forward(hand.kin, g, posture, X, 0)
        for i in range(n):
            T = T_object * X[runs.body[touch[i].run] - 1 - j0]
            touch[i] = nearest_touch(hand, obj, runs, T, touch[i], _SLIDES)
        added = next_link(runs, params, touch, task, n)
        if added < 0:
            break
        task[added] = _ASKED
        done, q = _ask_link(hand, obj, runs, params, g, pose, held.frozen[h, g], posture, touch, task, n)
        if done:
            posture = q
            made += 1
            for i in range(n):
                found[i] = touch[i]
        else:
            task[added] = _FAILED
    group_forward(hand.kin, g, posture, X, 0)
    clear = clear_of_all(hand, obj, held, params, h, g, pose, resting, X)
    if made > 0 and clear:
        surface = int(-1)
        further = vec_further(-1)
        more = int(0)
        for i in range(n):
            if task[i] == _ASKED and (i == first or more < FURTHER):
                at = contact_beside(hand, obj, runs, params, T_object * X[runs.body[found[i].run] - 1 - j0], found[i])
                if i == first:
                    surface = at
                elif at >= 0:
                    further[more] = at
                    further[FURTHER + more] = runs.place[found[i].run]
                    more += 1
        if surface >= 0 and more > 0:
            candidates_out.q[row, g, m] = posture
            candidates_out.surface[row, g, m] = surface
            candidates_out.further[row, g, m] = further
            wp.atomic_add(counts_out, WrapCount.WRAPPED, 1)
            return
    if made > 0:
        group_forward(hand.kin, g, candidates_out.q[row, g, m], X, 0)
        clear = clear_of_all(hand, obj, held, params, h, g, pose, resting, X)
    if clear:
        c = field.point[candidates_out.record[row, g, m]]
        T = T_object * X[hand.contacts.body[c] - 1 - j0]
        at = candidates_out.surface[row, g, m]
        clear = touches_there(hand, obj, params, hand.contacts.grid[c], T, at)
    if not clear:
        candidates_out.state[row, g, m] = State.BLOCKED

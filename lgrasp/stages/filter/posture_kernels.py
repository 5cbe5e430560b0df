"""Kernels that put the hand into a set's posture: used fingers first, unused ones after."""

import warp as wp

from lgrasp.field.arrays import Field, field_seed
from lgrasp.grasp.collision import body_clear
from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.kinematics import clamp_dofs, group_forward, vec_dof
from lgrasp.math.triangles import least_facing
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_DOUBT = wp.constant(3.0e-5)  # [m]


@wp.func
def _group_pairs_clear(hand: Hand, a: wp.int32, b: wp.int32, X: wp.array(dtype=wp.transform), margin: wp.float32):
    """Pairs of groups a <= b (0 = base, g + 1 = group g) of a whole hand, X[j] = pose of body 1 + j."""
    at = int(0)
    if a > 0:
        at = hand.kin.joint_first[a - 1]
    return group_pairs_clear(hand, a, b, X, at, X, hand.kin.joint_first[b - 1], margin)


@wp.kernel
def place_used(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    margin: wp.float32,
    max_gap: wp.float32,
    cosine: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    palm_point: wp.array(dtype=wp.int32),
    palm_surface: wp.array(dtype=wp.int32),
    surface: wp.array3d(dtype=wp.int32),
    record: wp.array3d(dtype=wp.int32),
    q: wp.array3d(dtype=vec_dof),
    set_pose: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    outcome_out: wp.array(dtype=wp.int32),
    body_out: wp.array2d(dtype=wp.transform),
    posture_out: wp.array2d(dtype=vec_dof),
    contact_out: wp.array2d(dtype=wp.int32),
    contact_surface_out: wp.array2d(dtype=wp.int32),
    gap_out: wp.array(dtype=wp.float32),
    dot_out: wp.array(dtype=wp.float32),
):
    """Postures and bodies of the touching fingers; contacts on the links' true meshes; collisions among these fingers.

    Contacts come in group order, that of the palm (or of a finger that stays as it is) last; unused places hold -1.
    """
    i = wp.tid()
    row = set_pose[i]
    h = index[row] // held.tries
    G = hand.kin.groups
    X = body_out[i]
    for g in range(G):
        if group_fixed(hand, held, h, g):
            posture_out[i, g] = held.posture[h, g]
            group_forward(hand.kin, g, held.posture[h, g], X, hand.kin.joint_first[g])
    T = pose[row]
    k = int(0)
    gap = float(0.0)
    dot = float(1.0)
    least = float(1.0)
    for g in range(G + 1):
        contact_out[i, g] = -1
        contact_surface_out[i, g] = -1
    for g in range(G + 1):
        s = int(-1)
        c = int(-1)
        B = wp.transform_identity()
        if g == G:
            if palm_point[row] >= 0:
                s = palm_surface[row]
                c = palm_point[row]
                if hand.contacts.body[c] > 0:
                    B = X[hand.contacts.body[c] - 1]
        elif chosen[i, g] >= 0:
            x = clamp_dofs(hand.kin, g, q[row, g, chosen[i, g]])
            posture_out[i, g] = x
            group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
            s = surface[row, g, chosen[i, g]]
            c = field.point[record[row, g, chosen[i, g]]]
            B = X[hand.contacts.body[c] - 1]
        if s >= 0:
            local = wp.transform_point(wp.transform_inverse(B), wp.transform_point(T, obj.contact_points[s]))
            inward = -wp.transform_vector(T, obj.contact_normals[s])
            mesh = hand.contacts.mesh[hand.contacts.grid[c]]
            hit = wp.mesh_query_point_no_sign(mesh, local, 0.05)
            d = float(1.0)
            a = float(-1.0)
            if hit.result:
                d = wp.length(local - wp.mesh_eval_position(mesh, hit.face, hit.u, hit.v))
                a = wp.dot(inward, wp.transform_vector(B, wp.mesh_eval_face_normal(mesh, hit.face)))
                # beside an edge rounding decides which facet is nearest, so all of them must do
                turned = wp.transform_vector(wp.transform_inverse(B), inward)
                least = wp.min(least, least_facing(mesh, local, d + _DOUBT, turned))
            gap = wp.max(gap, d)
            dot = wp.min(dot, a)
            contact_out[i, k] = c
            contact_surface_out[i, k] = s
            k += 1
    gap_out[i] = gap
    dot_out[i] = dot
    if gap > max_gap or wp.min(dot, least) < cosine:
        outcome_out[i] = 4
        return
    for g in range(G):
        if chosen[i, g] >= 0:
            clear = _group_pairs_clear(hand, 0, g + 1, X, margin)
            for f in range(G):
                if clear and (f == g or (chosen[i, f] >= 0 and f < g) or group_fixed(hand, held, h, f)):
                    clear = _group_pairs_clear(hand, wp.min(f, g) + 1, wp.max(f, g) + 1, X, margin)
            if not clear:
                outcome_out[i] = 2
                return
    outcome_out[i] = 0


@wp.kernel
def fill_unused(
    hand: Hand,
    field: Field,
    obj: Object,
    held: Held,
    seed: wp.array(dtype=wp.int32),
    max_depth: wp.float32,
    draws: wp.int32,
    slack: wp.float32,
    margin: wp.float32,
    index: wp.array(dtype=wp.int32),
    pose: wp.array(dtype=wp.transform),
    setting: wp.array(dtype=wp.int32),
    set_pose: wp.array(dtype=wp.int32),
    set_slot: wp.array(dtype=wp.int32),
    chosen: wp.array2d(dtype=wp.int32),
    depth: wp.array(dtype=wp.float32),
    outcome_out: wp.array(dtype=wp.int32),
    body_out: wp.array2d(dtype=wp.transform),
    posture_out: wp.array2d(dtype=vec_dof),
):
    """Postures of fingers without contact: random ones of the field, drawn ever closer to the open posture.

    A posture is taken when it is clear of the object, the palm and the fingers placed before.
    """
    i = wp.tid()
    if outcome_out[i] != 0:
        return
    if depth[i] > max_depth:
        outcome_out[i] = 3
        return
    row = set_pose[i]
    G = hand.kin.groups
    h = index[row] // held.tries
    state = wp.rand_init(seed[0], index[row] * 64 + set_slot[i])
    T_object = wp.transform_inverse(pose[row])
    X = body_out[i]
    for g in range(G):
        if chosen[i, g] < 0 and not group_fixed(hand, held, h, g):
            slot = setting[row] * G + g
            r0 = field.start[field.cell_first[slot] * 64]
            r1 = field.start[field.cell_first[slot + 1] * 64]
            first = hand.kin.dof_first[g]
            dofs = hand.kin.dof_first[g + 1] - first
            found = int(0)
            for t in range(draws):
                share = 1.0 - float(t + 1) / float(draws)
                x = vec_dof()
                for d in range(dofs):
                    x[d] = hand.kin.dof_setting[setting[row], first + d]
                if r1 > r0:
                    r = r0 + wp.min(int(wp.randf(state) * float(r1 - r0)), r1 - r0 - 1)
                    drawn = field_seed(field, hand.kin, slot, r)
                    # the values of shared joints are the same in both
                    x = x + share * (drawn - x)
                x = with_frozen(hand, held, h, g, x)
                group_forward(hand.kin, g, x, X, hand.kin.joint_first[g])
                clear = int(1)
                for k in range(hand.kin.joint_first[g], hand.kin.joint_first[g + 1]):
                    if clear == 1 and not body_clear(hand, obj, 1 + k, T_object * X[k], slack):
                        clear = 0
                if clear == 1 and not _group_pairs_clear(hand, 0, g + 1, X, margin):
                    clear = 0
                if clear == 1 and not _group_pairs_clear(hand, g + 1, g + 1, X, margin):
                    clear = 0
                for f in range(G):
                    # used fingers, those that stay, and unused ones that are placed already
                    if f != g and (chosen[i, f] >= 0 or f < g or group_fixed(hand, held, h, f)):
                        a = wp.min(g, f) + 1
                        b = wp.max(g, f) + 1
                        if clear == 1 and not _group_pairs_clear(hand, a, b, X, margin):
                            clear = 0
                if clear == 1:
                    posture_out[i, g] = x
                    found = 1
                    break
            if found == 0:
                outcome_out[i] = 1
                return

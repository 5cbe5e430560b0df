"""Kernels that sample the contact field."""

import warp as wp

from lgrasp.hand.arrays import Hand, contact_run, thumb_placed
from lgrasp.hand.self_collision import group_pairs_clear
from lgrasp.math.kinematics import Kinematics, group_forward, vec_dof
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.math.transforms import encode_normal, normal_bin
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Vectors:
    """Contact vectors, one a row."""

    point: wp.array(dtype=wp.int32)  # (M,) contact point
    position: wp.array(dtype=wp.vec3)  # (M,) of it [m], base frame
    bin: wp.array(dtype=wp.int32)  # (M,) of the normal
    normal: wp.array(dtype=wp.int32)  # (M,) packed
    direction: wp.array(dtype=wp.vec3)  # (M,) the normal as it is


@wp.func
def stored_posture(h: Kinematics, group: wp.int32, setting: wp.int32, codes: wp.array2d(dtype=wp.uint8), row: wp.int32):
    """Posture of a group [rad or m] that row ``row`` of codes (N, D) stands for, 8 bits a joint over its range; shared
    joints have exactly their value in the setting."""
    first = h.dof_first[group]
    free = h.dof_free[group]
    q = vec_dof()
    for d in range(h.dof_first[group + 1] - first):
        if d >= free:
            q[d] = h.dof_setting[setting, first + d]
            continue
        low = h.dof_lower[first + d]
        q[d] = low + (h.dof_upper[first + d] - low) * float(int(codes[row, d])) / 255.0
    return q


@wp.kernel
def sample_postures(
    hand: Hand,
    group: wp.int32,
    setting: wp.int32,
    seed: wp.int32,
    margin: wp.float32,
    posture_out: wp.array2d(dtype=wp.uint8),
    clear_out: wp.array(dtype=wp.int32),
):
    """Uniform postures of one group, and whether it keeps ``margin`` [m] to the static base and to itself, and the
    thumb is where it has to be.

    Args:
        posture_out: 8 bits a joint over its range, (N, D).
        clear_out: 1 where it does, (N,).
    """
    i = wp.tid()
    state = wp.rand_init(seed, i)
    for d in range(hand.kin.dof_free[group]):
        posture_out[i, d] = wp.uint8(wp.min(int(wp.randf(state) * 256.0), 255))
    q = stored_posture(hand.kin, group, setting, posture_out, i)
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    group_forward(hand.kin, group, q, X, 0)
    clear = group_pairs_clear(hand, 0, group + 1, X, 0, X, 0, margin)
    if clear:
        clear = group_pairs_clear(hand, group + 1, group + 1, X, 0, X, 0, margin)
    if clear:
        clear = thumb_placed(hand, group, X, 0)
    clear_out[i] = int(clear)


@wp.kernel
def contact_vectors(
    hand: Hand,
    group: wp.int32,
    setting: wp.int32,
    seed: wp.int32,
    posture: wp.array2d(dtype=wp.uint8),
    chosen: wp.array(dtype=wp.int32),
    vectors_out: Vectors,
):
    """Contact vector of a random contact point at each chosen posture (CF, Def. 4.1).

    Args:
        posture: as :func:`sample_postures` draws them, (N, D).
        chosen: rows of ``posture``, (M,).
    """
    i = wp.tid()
    state = wp.rand_init(seed, i)
    q = stored_posture(hand.kin, group, setting, posture, chosen[i])
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = group_forward(hand.kin, group, q, X, 0)
    run = contact_run(hand, setting, group)
    c0 = hand.contacts.first[run]
    points = hand.contacts.first[run + 1] - c0
    c = c0 + wp.min(int(wp.randf(state) * float(points)), points - 1)
    T = X[hand.contacts.body[c] - 1 - j0]
    n = wp.transform_vector(T, hand.contacts.normals[c])
    vectors_out.point[i] = c
    vectors_out.position[i] = wp.transform_point(T, hand.contacts.points[c])
    vectors_out.bin[i] = normal_bin(n)
    vectors_out.normal[i] = encode_normal(n)
    vectors_out.direction[i] = n

"""Poses and postures that candidates are given instead of drawing them, such as those of a network."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.field.model import ContactField
from lgrasp.grasp.held import Held, HeldArrays
from lgrasp.hand.arrays import Hand, HandArrays, contact_run
from lgrasp.hand.model import HandModel
from lgrasp.math.kinematics import group_forward, vec_dof
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.math.sdf import sdf_gradient
from lgrasp.object.arrays import Object, ObjectArrays
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)

_GAP_SCALE = wp.constant(0.002)
_ANGLE_SCALE = wp.constant(0.06)
"""A gap [m], and 1 - cosine of the angle of the normals, that count alike."""
_FAR = wp.constant(1.0e9)


@wp.struct
class Predicted:
    """N candidates, the first is candidate 0."""

    pose: wp.array(dtype=wp.transform)  # (N,) T_hand_object of the internal frame [m]
    posture: wp.array2d(dtype=vec_dof)  # (N, G) [rad or m]
    record: wp.array(dtype=wp.int32)  # (C,) a contact vector of the field by each contact point of the hand, -1 none
    hand_point: wp.array2d(dtype=wp.int32)  # (N, 2) of each side, the one that touches best, -1 none
    object_point: wp.array2d(dtype=wp.int32)  # (N, 2) the nearest, -1 none


@wp.func
def contact_place(hand: Hand, side: wp.int32, x: vec_dof, c: wp.int32):
    """Place and normal of contact point c of a side in the hand frame, with the side's joints at x."""
    if side < 0:
        return hand.contacts.points[c], hand.contacts.normals[c]
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = group_forward(hand.kin, side, x, X, 0)
    B = X[hand.contacts.body[c] - 1 - j0]
    return wp.transform_point(B, hand.contacts.points[c]), wp.transform_vector(B, hand.contacts.normals[c])


@wp.func
def touching_points(hand: Hand, obj: Object, T: wp.transform, setting: wp.int32, side: wp.int32, x: vec_dof):
    """Contact point of a side that touches an object at T best, with the side's joints at x; its place and normal in
    the hand frame; and the object's contact point nearest to it. Points are -1 where the side has none."""
    run = contact_run(hand, setting, side)
    first = hand.contacts.first[run]
    end = hand.contacts.first[run + 1]
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    j0 = int(0)
    if side >= 0:
        j0 = group_forward(hand.kin, side, x, X, 0)
    T_object = wp.transform_inverse(T)
    best = int(-1)
    least = float(_FAR)
    place = wp.vec3()
    normal = wp.vec3()
    match = wp.vec3()
    outward = wp.vec3()
    for c in range(first, end):
        B = wp.transform_identity()
        if side >= 0:
            B = X[hand.contacts.body[c] - 1 - j0]
        p = wp.transform_point(B, hand.contacts.points[c])
        n = wp.transform_vector(B, hand.contacts.normals[c])
        at = wp.transform_point(T_object, p)
        e = sdf_gradient(obj.sdf, at)
        out = wp.vec3(e[0], e[1], e[2])
        facing = -wp.dot(wp.transform_vector(T_object, n), out)
        badness = wp.abs(e[3]) / _GAP_SCALE + (1.0 - facing) / _ANGLE_SCALE
        if badness < least:
            least = badness
            best = c
            place = p
            normal = n
            match = at - out * e[3]
            outward = out
    surface = int(-1)
    least = float(_FAR)
    if best >= 0:
        for i in range(obj.contacts):
            away = wp.length_sq(obj.contact_points[i] - match)
            if away < least and wp.dot(obj.contact_normals[i], outward) > 0.5:
                least = away
                surface = i
    return best, place, normal, surface


@wp.kernel
def match_sides(hand: Hand, obj: Object, held: Held, predicted_out: Predicted):
    """One thread per (candidate, side): the contact points that touch best, see :func:`touching_points`."""
    i, side = wp.tid()
    h = i // held.tries
    g = held.sides[h][side]
    x = vec_dof()
    if g >= 0:
        x = predicted_out.posture[i, g]
    c, _p, _n, surface = touching_points(hand, obj, predicted_out.pose[i], held.setting[h], g, x)
    predicted_out.hand_point[i, side] = c
    predicted_out.object_point[i, side] = surface


@dataclass(frozen=True)
class TouchingGrasps:
    """Grasps of H rows with opposition spaces, whether good or not."""

    pose: np.ndarray
    """T_hand_object of the new object's internal frame, device poses (H, 7) f32."""
    q: np.ndarray
    """Joints, those that may not move bit by bit as given, (H, K) f32."""
    hand_point: np.ndarray
    """The point of each side that touches, index in ``contact_points`` of the hand, (H, 2)."""
    object_point: np.ndarray
    """The object's contact point nearest to each, index in ``contact_points`` of the object, (H, 2)."""


def upload_predicted(
    hand: HandArrays, obj: ObjectArrays, held: HeldArrays, record: np.ndarray, pose: np.ndarray, q: np.ndarray
) -> "Predicted":
    """Put predictions on the hand's device, and find where they touch.

    Args:
        held: rows with opposition spaces, which the candidates continue.
        record: see :func:`record_of_points`.
        pose: T_hand_object of the internal frame, device poses (N, 7). q: joints [rad or m], (N, K), frozen as held.
    """
    points = np.full((2, len(q), 2), -1, np.int32)
    values = {"pose": pose, "posture": hand.model.tree.by_group(q), "record": record}
    values |= {"hand_point": points[0], "object_point": points[1]}
    struct = upload_struct(Predicted, hand.device, values)
    wp.launch(match_sides, (len(q), 2), [hand.struct, obj.struct, held.struct], [struct], device=hand.device)
    return struct


def record_of_points(hand: HandModel, field: ContactField) -> np.ndarray:
    """The first contact vector of each contact point of a hand, -1 for those that no finger can reach, (C,)."""
    record = np.full(len(hand.contact_points), -1)
    point, first = np.unique(field.point, return_index=True)
    record[point] = first
    return record

"""The state of a hand that already holds objects: frozen joints and the objects, one row a sequence."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from lgrasp.grasp.collision import body_apart, body_depth
from lgrasp.hand.arrays import Hand, HandArrays
from lgrasp.math.kinematics import vec_dof
from lgrasp.math.limits import MAX_DOFS
from lgrasp.object.arrays import Object, ObjectArrays
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)

if TYPE_CHECKING:
    from lgrasp.hand.opposition.spaces import Space  # trimesh


@wp.struct
class Held:
    """H sequences so far; candidate c of a stream continues row ``c // tries``."""

    tries: wp.int32
    posture: wp.array2d(dtype=vec_dof)  # (H, G) [rad or m]
    frozen: wp.array2d(dtype=wp.int32)  # (H, G) bit d: dof d of the group must not move
    setting: wp.array(dtype=wp.int32)  # (H,) setting of the shared joints and surface of the space, -1: any
    sides: wp.array(dtype=wp.vec2i)  # (H,) groups of the two sides of the space, -1: static links; () without spaces
    objects: wp.int32  # n held by every row
    object: wp.array(dtype=Object)  # (n,)
    pose: wp.array2d(dtype=wp.transform)  # (H, n) T_hand_object of the internal frames


@dataclass(frozen=True)
class HeldArrays:
    """What is held on one device; keeps the objects alive."""

    struct: "Held"
    objects: tuple[ObjectArrays, ...]
    free: np.ndarray
    """Joints that may move, (H, K) bool."""
    setting: np.ndarray
    """See :class:`Held`, (H,)."""
    space: np.ndarray | None
    """Opposition space in which each row goes on, (H,); None: in none."""
    sides: np.ndarray | None
    """Groups of its two sides, -1: static links, (H, 2)."""


def hold_nothing(hand: HandArrays) -> HeldArrays:
    """An empty hand with every joint free: one row, which all candidates continue."""
    open_posture = hand.model.tree.joint_open[None].astype(np.float32)
    free: np.ndarray = np.zeros(open_posture.shape, bool)
    return hold(hand, open_posture, free, (), np.zeros((1, 0, 7), np.float32), tries=2**31 - 1, any_setting=True)


def hold(
    hand: HandArrays,
    q: np.ndarray,
    frozen: np.ndarray,
    objects: tuple[ObjectArrays, ...],
    pose: np.ndarray,
    *,
    tries: int,
    spaces: "Sequence[Space]" = (),
    space: np.ndarray | None = None,
    any_setting: bool = False,
) -> HeldArrays:
    """Put what H sequences hold on the hand's device.

    Args:
        q: joint positions [rad or m], (H, K).
        frozen: joints that must not move, (H, K) bool; besides, none moves that is not of the row's space.
        pose: their poses in the hand frame, internal frames, device poses (H, n, 7).
        tries: candidates that continue each row.
        spaces: opposition spaces, each with a contact surface of the hand. space: that of each row, (H,).
        any_setting: shared joints may still take any of their values; else they have those of q.
    """
    tree, d = hand.model.tree, hand.device
    rows, posture = len(q), tree.by_group(q.astype(np.float32))
    sides = None
    if space is not None:
        frozen = frozen | ~np.array([own.joints for own in spaces])[space]
        sides = np.array([own.groups for own in spaces], np.int32)[space]
    bits = (tree.by_group(frozen) << np.arange(MAX_DOFS)).sum(2).astype(np.int32)
    setting = np.full(rows, -1) if any_setting else _settings(q, tree.settings)
    if space is not None:
        setting += space * len(tree.settings)
    values = {"tries": tries, "posture": posture, "frozen": bits, "setting": setting}
    held = upload_struct(Held, d, values | ({} if sides is None else {"sides": sides}))
    held.objects = len(objects)
    held.object = wp.array([o.struct for o in objects], dtype=Object, device=d)
    held.pose = wp.array(np.reshape(pose, (-1, 7)), dtype=wp.transform, device=d).reshape((rows, len(objects)))
    return HeldArrays(held, objects, ~frozen, setting, space, sides)


def _settings(q: np.ndarray, settings: np.ndarray) -> np.ndarray:
    """Setting whose shared joints q has, (H,); only these differ between settings."""
    shared = np.ptp(settings, axis=0) > 0
    return np.abs(q[:, None, shared] - settings[None][:, :, shared]).sum(2).argmin(1)


@wp.func
def group_fixed(hand: Hand, held: Held, row: wp.int32, g: wp.int32):
    """True if the whole group is fixed."""
    own = (1 << hand.kin.dof_free[g]) - 1
    return own > 0 and (held.frozen[row, g] & own) == own


@wp.func
def with_frozen(hand: Hand, held: Held, row: wp.int32, g: wp.int32, q: vec_dof):
    """q of the group with its frozen dofs as they are held."""
    x = q
    bits = held.frozen[row, g]
    if bits != 0:
        for d in range(hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]):
            if ((bits >> d) & 1) == 1:
                x[d] = held.posture[row, g][d]
    return x


@wp.func
def body_clear_of_held(hand: Hand, held: Held, row: wp.int32, body: wp.int32, B: wp.transform, margin: wp.float32):
    """Whether all surface samples of a body are farther than ``margin`` [m] from all held objects. B = T_hand_body."""
    for k in range(held.objects):
        if not body_apart(hand, held.object[k], body, wp.transform_inverse(held.pose[row, k]) * B, margin):
            return False
    return True


@wp.func
def body_depth_in_held(hand: Hand, held: Held, row: wp.int32, body: wp.int32, B: wp.transform, limit: wp.float32):
    """Deepest penetration of the body and the held objects [m]; stops early above ``limit``. B = T_hand_body."""
    depth = float(0.0)
    for k in range(held.objects):
        T = wp.transform_inverse(held.pose[row, k]) * B
        depth = wp.max(depth, body_depth(hand, held.object[k], body, T, limit))
        if depth > limit:
            break
    return depth

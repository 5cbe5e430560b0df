"""Grasps of an object moved to its pose in a scene, and the collisions of the hand there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.geometry.poses import compose, device_from_stored, inverse
from lgrasp.hand.arrays import HandArrays, body_poses
from lgrasp.object.arrays import Object, ObjectArrays
from lgrasp.scenes import collision_kernels as kernels


@dataclass(frozen=True)
class Collisions:
    """How deep the hand of n grasps sinks into the table and into other objects, at q_pregrasp and at q.

    Depths above the limit that was asked for may be given too small, but not below it.
    """

    table: np.ndarray
    """[m], shape (n, 2), f32, 0 when apart."""
    objects: np.ndarray
    """[m], shape (n, 2), f32, 0 when apart; the object that is grasped does not count."""


def hand_poses(scene_object: np.ndarray, hand_object: np.ndarray) -> np.ndarray:
    """T_scene_hand of grasps, x y z [m] qw qx qy qz with qw >= 0, shape (n, 7), f64.

    Args:
        scene_object: T_scene_object, shape (7,).
        hand_object: T_hand_object of each grasp, as shards have it, shape (n, 7).
    """
    return compose(np.broadcast_to(scene_object, hand_object.shape), inverse(hand_object))


def find_collisions(
    hand: HandArrays,
    objects: Sequence[ObjectArrays],
    object_pose: np.ndarray,
    own: int,
    hand_pose: np.ndarray,
    q_pregrasp: np.ndarray,
    q: np.ndarray,
    limit: float,
) -> Collisions:
    """The whole hand against the half space z < 0 and all objects but one, by the exact tests of generation.

    Args:
        objects: what lies in the scene.
        object_pose: T_scene_object of their own frames, x y z [m] qw qx qy qz, shape (m, 7).
        own: the object that is grasped.
        hand_pose: T_scene_hand, shape (n, 7).
        q_pregrasp: actuated joints [rad or m], shape (n, K); q: the same at the grasp.
        limit: depth [m] that decides.
    """
    n, device = len(q), hand.device
    if not n:
        return Collisions(np.zeros((0, 2), np.float32), np.zeros((0, 2), np.float32))
    inward = inverse(object_pose)
    inward[:, :3] -= np.stack([o.model.center for o in objects])  # to the internal frames
    body = body_poses(hand, np.concatenate([q_pregrasp, q]))
    with wp.ScopedDevice(device):
        table, obstacle = wp.zeros(2 * n, dtype=wp.float32), wp.zeros(2 * n, dtype=wp.float32)
        inputs = [
            hand.struct,
            wp.array([o.struct for o in objects], dtype=Object),
            own,
            wp.array(device_from_stored(inward), dtype=wp.transform),
            wp.array(device_from_stored(np.concatenate([hand_pose, hand_pose])), dtype=wp.transform),
            wp.array(body, dtype=wp.transform),
            limit,
        ]
        wp.launch(kernels.hand_depths, body.shape[:2], inputs, [table, obstacle])
        return Collisions(table.numpy().reshape(2, n).T.copy(), obstacle.numpy().reshape(2, n).T.copy())

"""Grasps of an object on a table: the hand above the plane, and its straight way to the grasp."""

import numpy as np

from lgrasp.judge import bounds
from lgrasp.judge.collision import JudgedHand, JudgedObject, hand_in_object


def on_table(
    hand: JudgedHand,
    obj: JudgedObject,
    planes: np.ndarray,
    T_object: np.ndarray,
    T_links: np.ndarray,
    T_open: np.ndarray,
    back: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """How grasps stand to the table and to the way there.

    Args:
        planes: that the object rests on: unit normal up, height along it [m], any more; object's frame, shape [n, 5].
        T_object, T_links, T_open: poses of the object, of the links at the grasp and of those of the open hand, base
            frame, shapes [n, 4, 4] and [n, L, 4, 4].
        back: direction in which the open hand leaves, base frame, shape [n, 3].

    Returns:
        Depth of the lowest point of any link below the plane, at the grasp, open, and at the start of the way; distance
        of the object's lowest point from the plane; deepest penetration of open hand and object on the way [m], (n,).
    """
    back = back / np.linalg.norm(back, axis=1, keepdims=True)
    up = np.einsum("nij,nj->ni", T_object[:, :3, :3], planes[:, :3])
    height = planes[:, 3] + np.einsum("ni,ni->n", up, T_object[:, :3, 3])
    start = _moved(T_open, bounds.APPROACH_LENGTH * back)
    below = np.max([_below(hand, T, up, height) for T in (T_links, T_open, start)], axis=0)
    gap = np.abs((obj.mesh.vertices @ planes[:, :3].T).min(axis=0) - planes[:, 3])
    into, depth = np.linalg.inv(T_object)[:, None], np.zeros(len(back))
    for way in np.arange(0.0, bounds.APPROACH_LENGTH + 1e-9, bounds.APPROACH_STEP):
        depth = np.maximum(depth, np.max(hand_in_object(hand, obj, into @ _moved(T_open, way * back)), axis=0))
    return below, gap, depth


def _moved(T: np.ndarray, by: np.ndarray) -> np.ndarray:
    """Poses (n, L, 4, 4) moved by vectors (n, 3)."""
    out = T.copy()
    out[:, :, :3, 3] += by[:, None]
    return out


def _below(hand: JudgedHand, T_links: np.ndarray, up: np.ndarray, height: np.ndarray) -> np.ndarray:
    """How deep the lowest point of any link is below planes [m], (n,), negative above."""
    depth = np.full(len(T_links), -np.inf)
    for solid in hand.solids:
        T = T_links[:, solid.link]
        normal = np.einsum("nji,nj->ni", T[:, :3, :3], up)  # link's frame
        base = np.einsum("ni,ni->n", T[:, :3, 3], up) - height
        near = np.flatnonzero(solid.radius - normal @ solid.centre - base > depth)  # the others are higher as a whole
        lowest = (solid.samples @ normal[near].T).min(axis=0) + base[near]
        depth[near] = np.maximum(depth[near], -lowest)
    return depth

"""Tests that the links of an arm, and the hand's base on its tip, are apart."""

from itertools import pairwise

import numpy as np

from lgrasp.geometry.decompose import Decompose
from lgrasp.geometry.poses import device_from_matrix
from lgrasp.grasp.hand_files import checked_urdf
from lgrasp.grasp.records import HandRecord
from lgrasp.hand.arrays import upload_pieces
from lgrasp.hand.geometry import link_pieces
from lgrasp.hand.links import link_poses
from lgrasp.hand.pairs import ALMOST_ALWAYS, PAIR_POSTURES, placed_pieces_touch, separate_pairs
from lgrasp.hand.piece import Piece
from lgrasp.reach.arm import Arm


def base_pieces(record: HandRecord, decompose: Decompose | None = None) -> list[Piece]:
    """Convex pieces of the hand of a shard that do not move, in the frame of its base link [m].

    Raises:
        ShardError: a mesh is missing.
        HandError: the URDF or a mesh cannot be used.
    """
    with checked_urdf(record) as urdf:
        still = {record.base_link}
        for _ in urdf.joints:  # each adds a neighbour at least, or there is none
            ends = [{joint.parent, joint.child} for joint in urdf.joints if not joint.movable]
            still.update(*(pair for pair in ends if pair & still))
        T = link_poses(urdf, record.base_link, {})
        return [piece.moved(T[link][0]) for link in sorted(still) for piece in link_pieces(urdf, link, decompose)[0]]


class ArmSolids:
    """Convex pieces of the links of an arm and of the hand's base, and which of them must stay apart.

    Links that a joint joins may touch, and those that touch in nearly every posture.

    Args:
        hand: pieces of the hand's base, in the frame of its base link.
    """

    def __init__(self, arm: Arm, hand: list[Piece], decompose: Decompose | None = None) -> None:
        self._arm = arm
        solids = [*(link_pieces(arm.urdf, link, decompose)[0] for link in arm.links), hand]
        link = np.repeat(np.arange(len(solids)), [len(own) for own in solids])
        self._pieces = upload_pieces([piece for own in solids for piece in own], link, "cpu")
        names, moved = [*arm.links, ""], np.cumsum([0, *(joint.movable for joint in arm.joints), 0])
        self._pairs = separate_pairs(moved[link], link, names, pairwise(names))
        if len(self._pairs):
            low, high = arm.limits.T
            q = np.random.default_rng(1).uniform(low, high, (PAIR_POSTURES, len(low)))
            touch, (_, pair) = self._touch(q), np.unique(link[self._pairs], axis=0, return_inverse=True)
            share = np.array([touch[:, pair == k].any(1).mean() for k in range(pair.max() + 1)])
            self._pairs = self._pairs[share[pair] <= ALMOST_ALWAYS]

    def clear(self, q: np.ndarray) -> np.ndarray:
        """Postures, shape [n, J], without a collision: shape [n], bool."""
        return np.logical_not(self._touch(q).any(1))

    def _touch(self, q: np.ndarray) -> np.ndarray:
        """Which pairs touch at postures (n, J), (n, Q)."""
        if not len(q) or not len(self._pairs):
            return np.zeros((len(q), len(self._pairs)), bool)
        values = {joint.name: q[:, i] for i, joint in enumerate(self._arm.moving)}
        found = link_poses(self._arm.urdf, self._arm.links[0], values)
        T = [*(found[link] for link in self._arm.links), found[self._arm.tip] @ self._arm.T_tip_hand]
        pose = device_from_matrix(np.concatenate(T)).reshape(len(T), len(q), 7).swapaxes(0, 1)
        return placed_pieces_touch(self._pieces, pose, self._pairs)

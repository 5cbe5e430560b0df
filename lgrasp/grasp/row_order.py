"""The order of a shard's rows: shuffled by the seed, and the same however the stream of candidates was cut."""

import numpy as np

from lgrasp.grasp.schema import POSE_BITS
from lgrasp.grasp.tables import GraspTable
from lgrasp.seeding import mixed, stage_seed

_BLOCK_BITS, _KEY_BITS = np.uint64(26), np.uint64(38)  # the number of a block fits in 26 bits
_GAMMA = np.array([0x9E3779B97F4A7C15], np.uint64)


class RowOrder:
    """The order of the rows of one shard, whose blocks have ``block`` candidates."""

    def __init__(self, seed: int, shard: int, block: int) -> None:
        self._seed = stage_seed(seed, shard, "rows") * _GAMMA
        self._block = np.uint64(block)

    def shuffled(self, index: np.ndarray, slot: np.ndarray) -> np.ndarray:
        """Indices (N,) that put rows with these candidates and slots (N,) in the order in which they are written."""
        return np.argsort(self._keys(index, slot))

    def by_blocks(self, grasps: GraspTable) -> np.ndarray:
        """Indices (N,) that put blocks one after another, and the rows of each in random order."""
        block = (grasps.index.astype(np.uint64) & POSE_BITS) // self._block
        return np.argsort(block << _KEY_BITS | self._keys(grasps.index, grasps.slot) >> _BLOCK_BITS)

    def _keys(self, index: np.ndarray, slot: np.ndarray) -> np.ndarray:
        """Random numbers (N,) that belong to the rows: of the seed, the candidate and the search that found it."""
        return mixed(mixed(index.astype(np.uint64) + self._seed) + slot.astype(np.uint64) * _GAMMA)

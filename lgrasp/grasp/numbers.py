"""What the numbers in the column ``candidate`` tell of a row: the pose that it was made from, and where that is from.

The lowest 32 bits are a candidate of the shard's stream, the next 8 a pass over the candidates, the others the shard.
From pass MOVED_PASS on, poses are moved from ones that gave grasps: MOVES numbers belong to each candidate.
"""

import numpy as np

from lgrasp.grasp.schema import MOVED_PASS, MOVES, PASS_SHIFT

_PASSES = np.uint64(0xFF << PASS_SHIFT)
_IN_PASS = np.uint64((1 << PASS_SHIFT) - 1)
_FIRST_MOVED = np.uint64(MOVED_PASS << PASS_SHIFT)


def pose_numbers(candidate: np.ndarray) -> np.ndarray:
    """Of the poses that rows were made from, (N,) u64: the same for passes over one pose."""
    candidate = candidate.astype(np.uint64)
    return np.where(_moved(candidate), candidate, candidate & ~_PASSES)


def origins(candidate: np.ndarray) -> np.ndarray:
    """Of the poses that were drawn, not moved, and led to those of rows, (N,) u64."""
    candidate = candidate.astype(np.uint64)
    drawn = candidate & ~_PASSES
    number = drawn & _IN_PASS
    return np.where(_moved(candidate), drawn - number + number // np.uint64(MOVES), drawn)


def _moved(candidate: np.ndarray) -> np.ndarray:
    return (candidate & _PASSES) >= _FIRST_MOVED

"""Which rows were made from the same object pose."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from lgrasp.grasp.schema import PASS_SHIFT, POSE_BITS

_STREAM_BITS = np.uint64((1 << PASS_SHIFT) - 1)  # of the column candidate: its place in the stream of its shard


def pose_numbers(candidate: np.ndarray, config: Mapping[str, Any]) -> np.ndarray:
    """Numbers (N,) u64 that differ where rows were made from different poses.

    Args:
        candidate: column of the rows, (N,).
        config: of their shard: poses that were asked for come in turn, in every shard.
    """
    steered = config.get("steered")
    asked = steered.get("pose_count") if isinstance(steered, Mapping) else None
    if isinstance(asked, int) and asked > 0:
        return (candidate.astype(np.uint64) & _STREAM_BITS) % np.uint64(asked)
    return candidate.astype(np.uint64) & np.uint64(POSE_BITS)

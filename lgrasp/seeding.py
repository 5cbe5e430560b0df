"""One seed per stage and shard; kernels add the candidate index, never the batch."""

import hashlib
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np


def stage_seed(base: int, shard: int, stage: str, salt: int = 0) -> int:
    """31-bit seed of a stage's random stream in one shard; ``salt`` tells passes over the same candidates apart."""
    text = f"{base}/{shard}/{stage}/{salt}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little") & 0x7FFFFFFF


def mixed(values: "np.ndarray") -> "np.ndarray":
    """Random numbers that belong to numbers, uint64 of any shape: the finaliser of splitmix64."""
    import numpy as np  # not above: seeds are known where nothing is loaded

    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))

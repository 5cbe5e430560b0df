"""One seed per stage and shard; kernels add the candidate index, never the batch."""

import hashlib


def stage_seed(base: int, shard: int, stage: str, salt: int = 0) -> int:
    """31-bit seed of a stage's random stream in one shard; ``salt`` tells passes over the same candidates apart."""
    text = f"{base}/{shard}/{stage}/{salt}".encode()
    return int.from_bytes(hashlib.sha256(text).digest()[:4], "little") & 0x7FFFFFFF

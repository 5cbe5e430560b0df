"""What every stage is given beside its inputs and parameters."""

from dataclasses import dataclass

from lgrasp.field.arrays import FieldArrays
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays
from lgrasp.seeding import stage_seed

__all__ = ["Context"]


@dataclass(frozen=True)
class Context:
    """A hand, an object and a contact field on one device, and the random stream of one shard."""

    hand: HandArrays
    object: ObjectArrays
    field: FieldArrays
    device: str
    base_seed: int
    shard: int

    def seed(self, stage: str, salt: int = 0) -> int:
        """31-bit seed of a stage in this shard."""
        return stage_seed(self.base_seed, self.shard, stage, salt)

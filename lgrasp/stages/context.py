"""What every stage is given beside its inputs and parameters."""

from dataclasses import dataclass
from dataclasses import field as with_default

import warp as wp

from lgrasp.field.arrays import FieldArrays
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays
from lgrasp.physics.scene import Scene
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

    scene: Scene | None = None
    """What a physics simulation is given; there if the pipeline has one."""
    seeds: dict[tuple[str, int], wp.array] = with_default(default_factory=dict, repr=False, compare=False)

    def seed(self, stage: str, salt: int = 0) -> wp.array:
        """31-bit seed of a stage in this shard, (1,) i32 on the device."""
        if (stage, salt) not in self.seeds:
            value = stage_seed(self.base_seed, self.shard, stage, salt)
            self.seeds[stage, salt] = wp.full(1, value, dtype=wp.int32, device=self.device)
        return self.seeds[stage, salt]

"""What every stage is given beside its inputs and parameters."""

from dataclasses import dataclass
from dataclasses import field as with_default
from functools import cached_property
from typing import TYPE_CHECKING

import warp as wp

from lgrasp.field.arrays import FieldArrays
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.held import HeldArrays, hold_nothing
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays
from lgrasp.seeding import stage_seed

if TYPE_CHECKING:
    from lgrasp.hand.opposition.spaces import Space
    from lgrasp.simulate.scene import Scene


@dataclass(frozen=True)
class Context:
    """A hand, an object and a contact field on one device, and the random stream of one shard."""

    hand: HandArrays
    object: ObjectArrays
    field: FieldArrays
    device: str
    base_seed: int
    shard: int

    bounds: GraspBounds = with_default(default_factory=GraspBounds)
    """What a grasp must satisfy, and what its measures are measured with: those of the pipeline."""
    scene: "Scene | None" = None
    """What a physics simulation is given; there if the pipeline has one."""
    space: "Space | None" = None
    """Opposition space that grasps must use; hand and field are then those of the space."""
    holding: HeldArrays | None = None
    """What the hand holds already, and what of it may not move; None: nothing."""
    seeds: dict[tuple[str, int], wp.array] = with_default(default_factory=dict, repr=False, compare=False)

    @cached_property
    def held(self) -> HeldArrays:
        """What the hand holds already, of no rows but one if nothing."""
        return self.holding or hold_nothing(self.hand)

    def seed(self, stage: str, salt: int = 0) -> wp.array:
        """31-bit seed of a stage in this shard, (1,) i32 on the device."""
        if (stage, salt) not in self.seeds:
            value = stage_seed(self.base_seed, self.shard, stage, salt)
            self.seeds[stage, salt] = wp.full(1, value, dtype=wp.int32, device=self.device)
        return self.seeds[stage, salt]

"""The context that every stage gets in addition to its inputs and parameters."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from dataclasses import field as with_default
from functools import cached_property
from typing import TYPE_CHECKING, Any

import warp as wp

from lgrasp.field.arrays import FieldArrays
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.held import HeldArrays, hold_nothing
from lgrasp.grasp.predicted import Predicted
from lgrasp.hand.arrays import HandArrays
from lgrasp.object.arrays import ObjectArrays
from lgrasp.policy.arrays import PolicyArrays, upload_policy
from lgrasp.runtime.kept import Keeper
from lgrasp.seeding import stage_seed
from lgrasp.steer.arrays import SteerArrays, steer_nothing

if TYPE_CHECKING:
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
    holding: HeldArrays | None = None
    """What the hand holds already, what of it may not move, and the opposition spaces that grasps must use, which are
    the contact surfaces of hand and field then; None: nothing."""
    predicted: "Predicted | None" = None
    """Poses and postures of the candidates in opposition spaces; None: they are drawn."""
    steer: SteerArrays | None = None
    """What the user asks of grasps; None: nothing."""
    policy: PolicyArrays | None = None
    """What rates poses; None: opposed contacts."""
    realised: bool = True
    """True if the candidates that search combines are already realised (ik comes before search)."""
    salt: int = 0
    """Number of the pass over these candidates."""
    round: int = 0
    """Number of the round in which contacts are drawn for them."""
    kept: Keeper = with_default(default_factory=Keeper, repr=False, compare=False)
    """What stages keep from batch to batch of a job."""
    seeds: dict[tuple[str, int], wp.array] = with_default(default_factory=dict, repr=False, compare=False)

    @cached_property
    def held(self) -> HeldArrays:
        """What the hand holds already, of no rows but one if nothing."""
        return self.holding or hold_nothing(self.hand)

    @property
    def opposed(self) -> bool:
        """True if grasps must use opposition spaces."""
        return self.held.space is not None

    @cached_property
    def steered(self) -> SteerArrays:
        """What is asked, everything allowed if nothing is."""
        return self.steer or steer_nothing(self.hand)

    @cached_property
    def networks(self) -> PolicyArrays:
        """The networks of the policy, without rows if there is none."""
        return self.policy or upload_policy(None, self.device)

    def changed(self, **changes: Any) -> "Context":
        """A copy with some fields replaced, and what this one has on its device."""
        copy = replace(self, **{"holding": self.held, "steer": self.steered} | changes)
        copy.__dict__["networks"] = self.networks
        return copy

    def close(self) -> None:
        """Free what nobody else has on the device; seeds and what stands for nothing are made again if asked for."""
        self.seeds.clear()
        for name in ("held", "steered", "networks"):
            self.__dict__.pop(name, None)

    def once(self, kind: str, make: Callable[[], Any], *settings: Any) -> Any:
        """What a stage makes of hand, object and settings, and keeps from batch to batch of a job."""
        hand, obj = self.hand.model, self.object.model
        key = hand.sha256, len(hand.contact_points), obj.sha256, obj.scale, self.device, *settings
        return self.kept.get(kind, key, make)

    def with_salt(self, salt: int) -> "Context":
        """The same in another pass."""
        return self if salt == self.salt else self.changed(salt=salt)

    def seed(self, stage: str, salt: int = 0) -> wp.array:
        """31-bit seed of a stage in this shard, (1,) i32 on the device."""
        if (stage, salt) not in self.seeds:
            value = stage_seed(self.base_seed, self.shard, stage, salt)
            self.seeds[stage, salt] = wp.full(1, value, dtype=wp.int32, device=self.device)
        return self.seeds[stage, salt]

"""What a user steers grasps by; a pipeline carries it as its section ``steer``."""

from typing import Any

from pydantic import Field, field_validator

from lgrasp.choices import PalmUse
from lgrasp.config import Params

STEER_VERSION = 1
"""Raised whenever the same steering gives other grasps."""


class Steering(Params):
    """Where and how a hand is to grasp; as it is by default it asks for nothing."""

    fingers: tuple[str, ...] = Field(
        default=(),
        description="Fingers that all touch, and no others: names of hand.yaml, or one link of each; none: any.",
    )

    links: tuple[str, ...] = Field(
        default=(), description="Links whose contact surface may touch, and no other; none: any."
    )
    palm: PalmUse = Field(default="yes", description="Whether the palm touches: yes, it may; no; must.")

    @field_validator("palm", mode="before")
    @classmethod
    def _word(cls, value: Any) -> Any:
        return {True: "yes", False: "no"}[value] if isinstance(value, bool) else value  # as YAML reads them

    @field_validator("fingers", "links", mode="before")
    @classmethod
    def _names(cls, value: Any) -> Any:
        return tuple(name.strip() for name in value.split(",")) if isinstance(value, str) else value

    @property
    def asks(self) -> bool:
        """True if it asks for something."""
        return self != NOTHING

    def describe(self) -> dict[str, Any]:
        """What is asked, for content keys and shards; empty if it is nothing."""
        told = self.model_dump(mode="json", exclude_defaults=True)
        return told | {"version": STEER_VERSION} if told else {}


NOTHING = Steering()
"""Asks for nothing."""

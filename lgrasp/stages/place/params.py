"""Parameters of the place stage."""

import hashlib
from typing import ClassVar

from pydantic import Field, field_serializer

from lgrasp.config import Params
from lgrasp.policy.names import SHIPPED, policy_file

NO_BOUND = 10.0
"""[m] farther from the centre of mass than any line between two contacts."""

SOURCES = ("canonical", "exhaustive", "pinch", "palm")
"""Of poses; each has a weight."""


class PlaceParams(Params):
    """Where objects are put; weights need not sum to 1."""

    RENAMED: ClassVar = {"reach": "max_com_distance"}

    canonical: float = Field(
        default=0.6, ge=0, description="Weight of surface point to point of the canonical box, any rotation."
    )
    exhaustive: float = Field(
        default=0.2, ge=0, description="Weight of surface point on a contact vector of the field, any roll."
    )
    pinch: float = Field(
        default=0.6, ge=0, description="Weight of two opposite surface points between two opposed fingers, any roll."
    )
    palm: float = Field(default=0.1, ge=0, le=1e6, description="Weight of surface point pressed on the palm, any roll.")
    proposals: int | None = Field(
        default=None,
        ge=1,
        le=256,
        description="Poses tried per candidate; the one with the richest contacts stays; null: 8, above a table or "
        "plane, which blocks most, 24.",
    )
    samples: int = Field(
        default=24,
        ge=0,
        le=256,
        description="Surface points per finger that rate a pose; 0: none, a policy rates by the object's distances.",
    )
    max_com_distance: float = Field(
        default=NO_BOUND,
        gt=0,
        le=NO_BOUND,
        description="Contacts rate a pose when the line between two passes this near the centre of mass [m]; "
        "10, farther than any object is large, bounds nothing.",
    )
    policy: str | None = Field(
        default=None,
        description="What rates poses in place of opposed contacts: a file of 'learn fit --model pose', or hand: the "
        "one that is shipped with the hand, if there is one.",
    )
    policy_proposals: int | None = Field(
        default=None,
        ge=1,
        le=1024,
        description="Poses tried per candidate where a policy rates them; null: as many as it was learnt to be worth.",
    )
    policy_temperature: float = Field(
        default=0.5,
        ge=0,
        le=100,
        description="Of these one is drawn in proportion to its chance to the power of 1 over this; 0: the likeliest. "
        "More covers more of the ways to hold an object.",
    )
    table: bool = Field(
        default=False, description="The object rests on a table that grasps leave room for, the way to them included."
    )
    spins: int = Field(
        default=16,
        ge=1,
        le=360,
        description="Rolls about the contact normal tried for two points in an opposition space.",
    )

    @field_serializer("policy", when_used="json")
    def _by_content(self, value: str | None) -> str | None:
        return value if value in (None, SHIPPED) else hashlib.sha256(policy_file(value)).hexdigest()

    @property
    def weights(self) -> dict[str, float]:
        """Weight of each source, by name."""
        return {name: getattr(self, name) for name in SOURCES}

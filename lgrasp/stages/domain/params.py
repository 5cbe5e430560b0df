"""Parameters of the domain stage."""

from pydantic import Field

from lgrasp.config import Params


class DomainParams(Params):
    """How contact domains are drawn."""

    attempts: int = Field(default=128, ge=1, le=65536, description="Surface points looked up per pose and finger.")
    keep: int = Field(default=16, ge=1, le=4096, description="Most contacts kept per pose and finger.")
    angle: float = Field(
        default=20.0, gt=0, le=90, description="Largest angle of hand and object normal before IK [deg]."
    )
    fingers: int = Field(default=2, ge=1, le=8, description="Poses at which fewer fingers can touch are dropped.")
    rounds: int = Field(
        default=1, ge=1, le=16, description="Times that contacts are drawn, later ones where few could be realised."
    )
    enough: int = Field(default=6, ge=1, le=4096, description="Realised contacts of a finger that need no more.")
    later_cost: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="Cost of a pose after the first contacts, over that before; with a policy those that are not worth "
        "it are dropped, and less is covered. 0: none.",
    )

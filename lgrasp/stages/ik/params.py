"""Parameters of the ik stage."""

from typing import ClassVar

from pydantic import Field

from lgrasp.config import Params
from lgrasp.stages.least_squares import Damping, Gap, Indentation, JointStep


class IkParams(Params):
    """Two-point damped least squares on the contact; lengths in metres."""

    RENAMED: ClassVar = {"touch": "contact_indentation", "apart": "min_held_distance", "clearance": "check_collision"}

    iterations: int = Field(default=3, ge=1, le=200, description="Damped least-squares steps.")
    lever: float = Field(default=0.01, gt=0, le=0.1, description="Distance of the second point along the normal.")
    normal_weight: float = Field(default=0.15, gt=0, le=10, description="Weight of the second point.")
    damping: Damping = 2e-6
    step: JointStep = 0.3
    contact_indentation: Indentation = 0.0003
    gap: Gap = 0.001
    angle: float = Field(default=15.0, gt=0, le=60, description="Largest angle of the normals at the contact [deg].")
    min_held_distance: float = Field(
        default=0.0003, ge=0, le=0.05, description="Least distance of the finger from objects held."
    )
    check_collision: bool = Field(default=True, description="Also require the whole finger to be clear of the object.")
    resolved_penetration: float = Field(
        default=0.0,
        ge=0,
        le=0.01,
        description="Penetration of a finger's inner spheres that stage wrap is left to resolve [m], where that is "
        "more than bounds.allowed_penetration.",
    )

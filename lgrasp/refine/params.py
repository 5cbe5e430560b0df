"""Parameters of the local search and its energy; lengths in metres, angles in radians."""

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from lgrasp.config import Params

LENGTH = 0.01
"""The energy counts distances in this unit [m]."""
STEEPEST = 0.1
"""Share of the margin below which a barrier continues as a parabola of the same value, slope and curvature."""
_LOG = math.log(STEEPEST)
PARABOLA_SLOPE = -2 * (STEEPEST - 1) * _LOG - (STEEPEST - 1) ** 2 / STEEPEST
PARABOLA_BEND = -2 * _LOG - 4 * (STEEPEST - 1) / STEEPEST + (STEEPEST - 1) ** 2 / STEEPEST**2
"""Slope and curvature there."""
LIMIT_SHARE = 0.15
"""Joint limits repel within this share of the range."""

DISTAL, OTHER = 1.0, 0.2
"""Weight of palmar points on the last link of a finger, and of the others."""

# fields with other defaults in stage refine
MatchingRounds = Annotated[int, Field(ge=0, le=1000, description="Number of times that nearest points are matched.")]
TranslationStep = Annotated[float, Field(gt=0, le=0.1, description="Largest translation of the hand in one step.")]
RotationStep = Annotated[float, Field(gt=0, le=1, description="Largest rotation of the hand in one step.")]
JointStep = Annotated[float, Field(gt=0, le=1, description="Largest motion of a joint in one step.")]
EndReach = Annotated[float, Field(gt=0, le=1, description="What it falls towards, one matching after the last.")]
PointsWeight = Annotated[
    float, Field(ge=0, le=1e6, description="Weight of point-to-plane distances, per 1 cm squared.")
]
ForceWeight = Annotated[float, Field(ge=0, le=1e6, description="Weight of the net wrench of four contacts.")]
BarrierMargin = Annotated[float, Field(gt=0, le=0.05, description="Distance below which the barrier acts.")]


class LocalSearch(Params):
    """Weights of the energy, and how far and how often poses are moved."""

    RENAMED: ClassVar[dict[str, str]] = {
        "outer": "matching_rounds",
        "inner": "gradient_steps",
        "shift": "max_translation_step",
        "turn": "max_rotation_step",
        "bend": "max_joint_step",
        "withdraw": "max_exit_distance",
    }

    matching_rounds: MatchingRounds = 20
    gradient_steps: int = Field(default=10, ge=1, le=1000, description="Gradient steps after each matching.")
    optimizer: Literal["adam", "sgd"] = Field(default="adam", description="adam, or sgd with momentum.")
    momentum: float = Field(default=0.9, ge=0, lt=1, description="Of sgd; the decay of adam's first moment.")
    max_translation_step: TranslationStep = 0.0015
    max_rotation_step: RotationStep = 0.015
    max_joint_step: JointStep = 0.02
    decay: float = Field(default=0.05, gt=0, le=1, description="Size of a step after the last over that of the first.")
    reach: float = Field(
        default=0.02, gt=0, le=1, description="Points farther from the object do not pull, first matching."
    )
    reach_end: EndReach = 0.01
    soft: float = Field(default=0.004, gt=0, le=1, description="Distance about which pulls stop growing.")
    touching: int = Field(default=4, ge=1, le=16, description="Palmar points of a link, nearest first, that pull.")
    max_exit_distance: float = Field(
        default=0.012,
        ge=0,
        le=0.1,
        description="How far a hand deep in the object may be moved straight out; four times as far once opened.",
    )
    points: PointsWeight = 1.0
    normals: float = Field(default=0.02, ge=0, le=1e6, description="Weight of normals that do not oppose.")
    force: ForceWeight = 0.05
    barrier: float = Field(
        default=0.002, ge=0, le=1e6, description="Weight of the barriers against penetration, per point."
    )
    limits: float = Field(default=0.01, ge=0, le=1e6, description="Weight of the barrier at the joint limits.")
    margin: BarrierMargin = 0.003
    link_margin: float = Field(default=0.001, gt=0, le=0.05, description="The same between links.")
    contacts: int = Field(default=4, ge=2, le=16, description="Contacts that the net wrench is made of.")
    nearest: float = Field(
        default=0.2, gt=0, le=1, description="Share of the palmar points, nearest first, they come from."
    )


COARSE = LocalSearch(matching_rounds=13, reach=0.05, reach_end=0.03)
"""For poses as a network predicts them: off by centimetres."""

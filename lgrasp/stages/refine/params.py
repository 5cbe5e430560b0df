"""Parameters of the refine stage."""

from pydantic import Field

from lgrasp.refine.params import (
    BarrierMargin,
    EndReach,
    ForceWeight,
    JointStep,
    LocalSearch,
    MatchingRounds,
    PointsWeight,
    RotationStep,
    TranslationStep,
)


class RefineParams(LocalSearch):
    """How finished grasps are moved: in small steps, and drawn to balance."""

    tries: int = Field(
        default=6, ge=1, le=100, description="Most searches for a row that does not pass; further ones start nearby."
    )
    matching_rounds: MatchingRounds = 8
    max_translation_step: TranslationStep = 0.0005
    max_rotation_step: RotationStep = 0.005
    max_joint_step: JointStep = 0.01
    reach_end: EndReach = 0.02
    force: ForceWeight = 0.3
    points: PointsWeight = 3.0
    margin: BarrierMargin = 0.0015

"""Parameters of the refine stage."""

from pydantic import Field

from lgrasp.refine.params import LocalSearch


class RefineParams(LocalSearch):
    """How finished grasps are moved: in small steps, and drawn to balance."""

    tries: int = Field(
        default=6, ge=1, le=100, description="Most searches for a row that does not pass; further ones start nearby."
    )
    matching_rounds: int = Field(
        default=8, ge=0, le=1000, description="Number of times that nearest points are matched."
    )
    max_translation_step: float = Field(
        default=0.0005, gt=0, le=0.1, description="Largest translation of the hand in one step."
    )
    max_rotation_step: float = Field(default=0.005, gt=0, le=1, description="Largest rotation of the hand in one step.")
    max_joint_step: float = Field(default=0.01, gt=0, le=1, description="Largest motion of a joint in one step.")
    reach_end: float = Field(default=0.02, gt=0, le=1, description="As reach, at the last matching.")
    force: float = Field(default=0.3, ge=0, le=1e6, description="Weight of the net wrench of four contacts.")
    points: float = Field(default=3.0, ge=0, le=1e6, description="Weight of point-to-plane distances, per cm squared.")
    barrier: float = Field(default=0.002, ge=0, le=1e6, description="Weight of the barriers, per point.")
    margin: float = Field(default=0.0015, gt=0, le=0.05, description="Distance below which the barrier acts.")

"""Parameters of the refine stage."""

from pydantic import BaseModel, ConfigDict, Field

from lgrasp.refine.params import GraspBounds, LocalSearch

__all__ = ["RefineParams"]


class RefineParams(BaseModel):
    """How finished grasps are moved, and what the moved ones must satisfy: the bounds of filter."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    search: LocalSearch = Field(
        default=LocalSearch(outer=8, shift=0.0005, turn=0.005, bend=0.01, reach=0.02, reach_end=0.02, force=0.3),
        description="The local search.",
    )
    bounds: GraspBounds = Field(
        default=GraspBounds(), description="What a refined grasp must satisfy to take the place of its row."
    )

"""Parameters of plans."""

from pydantic import Field

from lgrasp.config import Params
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.hold.params import HoldTest
from lgrasp.refine.params import DISTAL, OTHER, LocalSearch

_CLOUD_GAP = 6.0e-3  # [m]
_PLAN_BOUNDS = GraspBounds(profile="plan")


class PlanParams(Params):
    """How many hands are tried, how far they are moved, and the conditions on a plan."""

    rolls: int = Field(
        default=30, ge=1, le=64, description="Hands that begin at each start, turned about the palm's normal."
    )
    draws: int = Field(default=8, ge=1, le=64, description="Hands that a network draws for each start.")
    thicker: float = Field(
        default=0.005,
        ge=0,
        le=0.05,
        description="How far the sides of a cloud that nobody saw are taken to reach beyond where a network puts them: "
        "fingers that wait outside close until they touch.",
    )
    tilts: tuple[float, ...] = Field(
        default=(0.0, 45.0, 90.0),
        min_length=1,
        description="Angles between the surface's normal and the way back from it [deg], in turn.",
    )
    finalists: int = Field(
        default=10, ge=1, le=64, description="Number of hands that continue after the first matchings."
    )
    opening: int = Field(default=5, ge=1, le=100, description="Matchings of all of them.")
    clearance: float = Field(
        default=0.004, ge=0, le=0.1, description="Distance at which the open hand stops before the object."
    )
    distal: float = Field(
        default=DISTAL, ge=0, le=100, description="Weight of palmar points on the last links of fingers."
    )
    other: float = Field(default=OTHER, ge=0, le=100, description="Weight of the other palmar points.")
    search: LocalSearch = Field(
        default=LocalSearch(
            max_exit_distance=0.0,
            max_translation_step=0.002,
            max_rotation_step=0.02,
            max_joint_step=0.04,
            reach=0.15,
            reach_end=0.1,
            soft=0.01,
            force=0.3,
            margin=0.005,
        ),
        description="The local search.",
    )
    rank_friction: float = Field(
        default=0.3, gt=0, le=2, description="Friction coefficient at which the hands of a start are compared."
    )
    tried: int | None = Field(
        default=None,
        ge=0,
        le=64,
        description="Hands of each start that are tried at most, those that resist most first, until one always holds: "
        "the one that holds most often is the plan. 0: none; default: 3 of those that a network draws, else 10.",
    )
    hold: HoldTest | None = Field(
        default=None, description="How they are tried; default: once those that a network draws, others with draws."
    )
    bounds: GraspBounds = Field(default=_PLAN_BOUNDS, description="What a plan must satisfy.")

    def trials(self, *, drawn: bool) -> tuple[int, HoldTest]:
        """``tried`` and ``hold`` as they are, of hands that a network drew or not."""
        tried, hold = (3, HoldTest(draws=0)) if drawn else (10, HoldTest())
        return tried if self.tried is None else self.tried, self.hold or hold

    def weights(self) -> dict[str, float]:
        """Arguments of :func:`hand_surface`."""
        return {"distal": self.distal, "other": self.other}


def cloud_params(params: PlanParams) -> PlanParams:
    """The parameters for an object that is a point cloud, whose points lie off its surface by their noise."""
    bounds = params.bounds.changed(max_gap=max(params.bounds.max_gap, _CLOUD_GAP))
    return params.model_copy(update={"bounds": bounds})

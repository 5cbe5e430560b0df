"""Parameters of plans."""

from typing import Any, NamedTuple

from pydantic import Field

from lgrasp.config import Params
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.hold.params import HoldTest
from lgrasp.refine.params import DISTAL, OTHER, LocalSearch

_CLOUD_GAP = 6.0e-3  # [m]
_FEW_FINGERS = 3
_DRAWN_ROUNDS = 16  # 20 give no more plans that hold, 12 a few fewer
_PLAN_BOUNDS = GraspBounds(profile="plan")
_DRAWN_HOLD = 0.75  # six of eight draws
_UNSURE_HOLD = 0.375  # three, where few hands hold


class Effort(NamedTuple):
    """What :class:`PlanParams` leaves to the kind of hands, by the names there."""

    draws: int
    finalists: int
    tried: int
    hold: HoldTest
    search: LocalSearch
    bounds: GraspBounds


class PlanParams(Params):
    """How many hands are tried, how far they are moved, and the conditions on a plan."""

    rolls: int = Field(
        default=30, ge=1, le=64, description="Hands that begin at each start, turned about the palm's normal."
    )
    draws: int | None = Field(
        default=None,
        ge=1,
        le=64,
        description="Hands that a network draws for each start; default: 24, or 40 where a hand has three fingers or "
        "fewer, or a cloud shows one side, which hold less often.",
    )
    tilts: tuple[float, ...] = Field(
        default=(0.0, 45.0, 90.0),
        min_length=1,
        description="Angles between the surface's normal and the way back from it [deg], in turn.",
    )
    finalists: int | None = Field(
        default=None,
        ge=1,
        le=64,
        description="Hands of each start that continue after the first matchings; default: 12 of 24 and 24 of 40 that "
        "a network draws, else 10.",
    )
    opening: int = Field(default=5, ge=1, le=100, description="Matchings of all of them.")
    matching_rounds: int | None = Field(
        default=None,
        ge=1,
        le=1000,
        description="Matchings of those that continue; default: 16 of those that a network draws for more than three "
        "fingers, else those of `search`.",
    )
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
        "the one that holds most often is the plan. 0: none; default: 8 of those that a network draws, 16 for "
        "more than three fingers and a cloud of one side, else 10.",
    )
    hold: HoldTest = Field(default=HoldTest(draws=8), description="How they are tried.")
    min_hold_probability: float | None = Field(
        default=None,
        ge=0,
        le=1,
        description="Least share of the draws in which a hand that is tried must hold to be a plan, above 0 also in "
        "the trial without; default: that of `bounds` if it has one, else 0.75 of those that a network draws, 0.375 "
        "for three fingers or fewer, or if a cloud shows one side, of which several guesses are tried.",
    )
    bounds: GraspBounds = Field(default=_PLAN_BOUNDS, description="What a plan must satisfy.")

    def effort(self, fingers: int | None, unsure: bool = False) -> Effort:
        """For hands with so many fingers that a network draws, or open ones (None); ``unsure``: a camera saw one side
        of it."""
        own: dict[str, Any] = {"draws": 1, "finalists": 10, "tried": 10}
        own["matching_rounds"] = self.search.matching_rounds
        own["min_hold_probability"] = least = self.bounds.min_hold_probability
        if fingers is not None:
            few = fingers <= _FEW_FINGERS
            own |= {"draws": 40, "finalists": 24} if few or unsure else {"draws": 24, "finalists": 12}
            own |= {"tried": 8} if few or not unsure else {"tried": 16}
            own |= {} if few else {"matching_rounds": _DRAWN_ROUNDS}
            own["min_hold_probability"] = least or (_UNSURE_HOLD if few or unsure else _DRAWN_HOLD)
        own |= {name: given for name in own if (given := getattr(self, name)) is not None}
        search = self.search.model_copy(update={"matching_rounds": own.pop("matching_rounds")})
        least = own.pop("min_hold_probability")
        bounds = self.bounds.changed(min_hold_probability=least if own["tried"] else 0.0)
        return Effort(hold=self.hold, search=search, bounds=bounds, **own)


def cloud_params(params: PlanParams) -> PlanParams:
    """The parameters for an object that is a point cloud, whose points lie off its surface by their noise."""
    bounds = params.bounds.changed(max_gap=max(params.bounds.max_gap, _CLOUD_GAP))
    return params.model_copy(update={"bounds": bounds})

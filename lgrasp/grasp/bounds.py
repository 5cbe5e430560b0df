"""The one declaration of a valid grasp: every bound that a row must meet, and the parameters of its measures."""

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from pydantic import Field, ValidationInfo, model_validator

from lgrasp.config import Params, parse_model
from lgrasp.errors import ConfigError
from lgrasp.math.constants import DRIVE_STIFFNESS

if TYPE_CHECKING:
    import numpy as np

ANY_CLOSING = 10.0
"""[rad or m]; joints never close by so much."""
ANY_PENETRATION = 0.03
"""[m]; closing fingers never penetrate more, as it is measured."""
ANY_SWEEP = 1.0
"""[m]; closing links never move so far inside an object."""

PROFILES: dict[str, dict[str, float]] = {
    "strict": {},
    "plan": {
        "max_gap": 0.004,
        "max_normal_angle": 45.0,
        "max_normal_spread": 60.0,
        "max_penetration": 0.002,
        "min_self_distance": 0.0,
        "max_gswo": 10.0,
        "squeeze_force": 60.0,
    },
}
"""Named profiles: ``strict`` are the defaults; ``plan`` is what a plan from far away must meet, whose residual is not
bounded."""


class GraspBounds(Params):
    """Bounds of a finished grasp and of its control poses; numbers that are not given come from the profile.

    Lengths in metres, angles in degrees. A pipeline declares them once, under ``bounds``; no stage has its own.
    """

    profile: str = Field(default="strict", description="Where numbers that are not given come from: strict or plan.")
    max_gap: float = Field(
        default=0.0013, gt=0, le=0.05, description="Largest distance of link and object at a contact."
    )
    max_normal_angle: float = Field(
        default=17.0, gt=0, le=180, description="Largest angle of the normals of link and object at a contact [deg]."
    )
    max_normal_spread: float = Field(
        default=20.0, gt=0, le=180, description="Largest angle of the object's normals about a contact [deg]."
    )
    max_penetration: float = Field(default=0.0008, ge=0, le=0.02, description="Largest penetration of hand and object.")
    allowed_penetration: float = Field(
        default=0.0005, ge=0, le=0.01, description="Penetration of a finger's inner spheres that quick tests forgive."
    )
    min_self_distance: float = Field(
        default=0.0003, ge=0, le=0.01, description="Least distance of links that do not touch."
    )
    min_object_distance: float = Field(
        default=0.0005,
        ge=-0.01,
        le=0.05,
        description="Least distance of the object from objects held; below 0 they may overlap.",
    )
    min_contacts: int = Field(default=2, ge=2, le=7, description="Fewest contacts, each on a link of its own.")
    friction: float = Field(default=0.5, gt=0, le=2, description="Friction coefficient of every measure.")
    torque_scale: float = Field(
        default=10.0, gt=0, le=1000, description="Weight of torque against force in fswo, gswo [1/m]."
    )
    max_gswo: float = Field(default=0.035, gt=0, le=10, description="Largest residual of gswo (norm).")
    max_unresisted_load: float = Field(
        default=1.0, gt=0, le=1, description="Largest part of a unit force that is not resisted; 1 asks for nothing."
    )
    min_epsilon: float = Field(
        default=0.0, ge=0, le=1, description="Least Ferrari-Canny quality (metric epsilon); 0 asks for nothing."
    )
    min_force_share: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        description="Least share of the squeeze's normal force on a contact; 0 asks for nothing.",
    )
    min_hold_probability: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="Least share of the trials of stage hold in which a grasp holds, above 0 also in the trial without "
        "random numbers; 0 asks for nothing.",
    )
    pregrasp_distance: float = Field(
        default=0.015, ge=0, le=0.1, description="How far q_pregrasp backs off along the contact normals."
    )
    min_pregrasp_distance: float = Field(
        default=0.001, ge=0, le=0.05, description="Least distance of touching fingers and object in q_pregrasp."
    )
    max_closing_travel: float = Field(
        default=ANY_CLOSING,
        ge=0,
        le=ANY_CLOSING,
        description="Farthest that a joint moves from q_pregrasp to q [rad or m]; 10 asks for nothing.",
    )
    max_closing_penetration: float = Field(
        default=ANY_PENETRATION,
        ge=0,
        le=ANY_PENETRATION,
        description="Largest penetration of fingers and object two thirds of the way from q_pregrasp to q [m]; "
        "0.03 asks for nothing.",
    )
    max_closing_sweep: float = Field(
        default=ANY_SWEEP,
        ge=0,
        le=ANY_SWEEP,
        description="Farthest that a link moves inside the object from q_pregrasp to q [m]; 1 asks for nothing.",
    )
    min_pregrasp_opening: float = Field(
        default=0.0,
        ge=0,
        le=1,
        description="How far each touching finger opens for q_pregrasp at least, its joint that moves most [rad or m]; "
        "0 asks for nothing.",
    )
    min_table_distance: float = Field(
        default=0.001, ge=0, le=0.05, description="Least distance of the hand from the table, where there is one."
    )
    squeeze_force: float = Field(
        default=15.0, ge=0, le=1000, description="Normal forces together that q_squeeze presses with [N]."
    )
    squeeze_stiffness: float = Field(
        default=DRIVE_STIFFNESS, gt=0, le=1e6, description="Position control that q_squeeze is meant for [N m/rad]."
    )

    min_squeeze_travel: float = Field(
        default=0.0,
        ge=0,
        le=0.1,
        description="How far q_squeeze would take the contacts if the object gave way, mean by force [m]; 0 asks for "
        "nothing.",
    )

    min_stable_squeeze: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="Least force at which a squeeze of soft joints would push the object out sideways [N]; 0 asks for "
        "nothing.",
    )
    min_stable_pinch: float = Field(
        default=0.0,
        ge=0,
        le=1000,
        description="The same for grasps of two contacts, about which an object turns easily [N]; min_stable_squeeze "
        "counts where it is more.",
    )
    squeeze_margin: float = Field(
        default=0.0,
        ge=0,
        le=100,
        description="How many times smaller than that the force of q_squeeze is at least; the hand presses with less "
        "where it must; 0 asks for nothing.",
    )

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, dict):
            return data
        profile = data.get("profile", "strict")
        if profile not in PROFILES:
            raise ValueError(f"unknown profile {profile!r}; profiles: {', '.join(PROFILES)}")
        return PROFILES[profile] | data

    def changed(self, **changes: float) -> "GraspBounds":
        """A copy with some numbers replaced and checked; with another profile, that one's numbers and the changes."""
        kept = {} if "profile" in changes else self.model_dump()
        return GraspBounds.model_validate(kept | changes)

    @property
    def limits(self) -> dict[str, float]:
        """Largest value of each stored metric that is bounded."""
        limits = {
            "gap": self.max_gap,
            "normal_error": math.radians(self.max_normal_angle),
            "penetration": self.max_penetration,
            "gswo": self.max_gswo,
        }
        return limits | ({"unresisted_load": self.max_unresisted_load} if self.max_unresisted_load < 1 else {})

    def met_by(self, metrics: "Mapping[str, np.ndarray]") -> "np.ndarray":
        """Rows whose stored metrics are within the bounds, (N,) bool; the metrics must have this friction or less.

        Raises:
            KeyError: a metric is missing.
        """
        import numpy as np  # not above: bounds are told wrong before anything is loaded

        return np.logical_and.reduce([metrics[name] <= np.float32(limit) for name, limit in self.limits.items()])

    def held_by(self, metrics: "Mapping[str, np.ndarray]") -> "np.ndarray":
        """Rows that hold as often as is asked, by their metrics of the hold test, (N,) bool."""
        if self.min_hold_probability == 0:
            return metrics["hold_probability"] >= 0
        return (metrics["hold_success"] > 0) & (metrics["hold_probability"] >= self.min_hold_probability - 1e-6)

    @property
    def told(self) -> str:
        """By what rows are valid: the profile, and the numbers that allow more than it does."""
        usual = GraspBounds(profile=self.profile)

        def looser(name: str) -> bool:
            own, strict = getattr(self, name), getattr(usual, name)
            return own < strict if name.startswith("min_") else own > strict

        bounded = (n for n in type(self).model_fields if n.startswith(("max_", "min_")) or n == "friction")
        names = [name for name in bounded if looser(name)]
        return f"{self.profile}, but for {', '.join(names)}" if names else self.profile

    def describe(self) -> dict[str, Any]:
        """As shards store them: the profile, and every number."""
        return {"profile": self.profile, "numbers": self.model_dump(mode="json", exclude={"profile"})}


def stages_told(config: Mapping[str, Any], name: str) -> list[Mapping[str, Any]]:
    """Parameters of the stages of that name in the pipeline that made a shard, by its ``config``."""
    pipeline = config.get("pipeline")
    stages = pipeline.get("stages") if isinstance(pipeline, dict) else None
    found = [stage.get(name) for stage in stages if isinstance(stage, dict)] if isinstance(stages, list) else []
    return [params for params in found if isinstance(params, dict)]


def stored_bounds(config: Mapping[str, Any], where: object = "shard") -> GraspBounds:
    """The bounds that the rows of a shard passed, by its ``config``; of shards that tell none, the strict ones with the
    friction that their filter had.

    Raises:
        ConfigError: a number that cannot be.
    """
    told = config.get("bounds")
    if told:
        known = {name: x for name, x in told["numbers"].items() if name in GraspBounds.model_fields}
        profile = told["profile"] if told["profile"] in PROFILES else "strict"
        return parse_model(GraspBounds, {"profile": profile} | known, f"{where}: bounds")
    for params in stages_told(config, "filter"):
        if "friction" in params:
            return parse_model(GraspBounds, {"friction": params["friction"]}, f"{where}: bounds")
    return GraspBounds()


def measured_strictly(config: Mapping[str, Any]) -> bool:
    """Whether rows of a shard can be strictly valid, by its ``config``: forces were balanced with no more than the
    strict friction, as far as it says."""
    try:
        return stored_bounds(config).friction <= GraspBounds().friction
    except (AttributeError, ConfigError, KeyError, TypeError, ValueError):  # of another writer
        return True

"""Parameters of the search stage."""

from typing import Annotated, Literal

from pydantic import Field

from lgrasp.choices import ScoreName
from lgrasp.config import Params
from lgrasp.math.limits import MAX_GROUPS, MAX_KINDS

MAX_RESTARTS = 4096
"""Most starts per pose."""


class SearchParams(Params):
    """How contacts are combined into sets that balance."""

    method: Literal["swap", "mutate"] = Field(
        default="swap",
        description="swap: contacts are replaced by others of their finger, and sets tested for friction, fingers for "
        "collision; mutate: as published, contacts move to the best of several mutations.",
    )
    contacts: tuple[Annotated[int, Field(ge=1, le=MAX_GROUPS)], ...] = Field(
        default=(3, 3, 3, 3, 4),
        min_length=1,
        max_length=MAX_KINDS,
        description="Finger contacts k of the first round, drawn evenly; the largest bounds later rounds. The default "
        "stands for the hand's own, if it has some.",
    )
    score: ScoreName = Field(
        default="fswo", description="Residual that the search lowers: frictionless or with friction."
    )
    threshold: float = Field(default=0.1, gt=0, le=1, description="Squared residual at which a set is taken.")
    gswo_share: float = Field(
        default=6 / 7,
        gt=0,
        le=1,
        description="swap: largest gswo residual of a set, in round cones, over bounds.max_gswo.",
    )
    least_force: float = Field(
        default=0.03, ge=0, le=0.5, description="swap: smallest share of the normal force on a contact."
    )
    sweeps: int = Field(default=5, ge=0, le=1000, description="mutate: passes over the contacts of a start.")
    pivots: int = Field(default=3, ge=1, le=64, description="mutate: contacts moved in a sweep, the first of a set.")
    mutations: int = Field(
        default=6, ge=1, le=1024, description="mutate: points tried for a contact, of which the best counts."
    )
    mutation_sigma: float = Field(
        default=5.0,
        ge=0,
        le=1000,
        description="mutate: standard deviation of these in the tangent plane, over sqrt(area / contact points).",
    )
    restarts: int = Field(default=20, ge=1, le=MAX_RESTARTS, description="Random starts per pose.")
    moves: int = Field(default=12, ge=0, le=1000, description="swap: replacements of one contact per start and round.")
    rounds: int = Field(
        default=2,
        ge=1,
        le=4,
        description="swap: rounds per start; each after the first adds a finger if that is needed and k allows.",
    )
    check_depth: bool = Field(
        default=False,
        description="swap: fingers of a set must be clear of the object by every surface point; postures that are not "
        "are left out of later starts.",
    )
    check_opening: bool = Field(
        default=False,
        description="swap: the same for fingers that cannot open by bounds.min_pregrasp_opening, or would close from "
        "farther than bounds.max_closing_travel.",
    )
    check_pairs: bool = Field(
        default=False,
        description="swap: which postures of two fingers meet is found before sets are made, where a finger has at "
        "most 32, and no start combines them; pays where most sets fail by that.",
    )
    per_pose: int = Field(default=3, ge=1, le=MAX_RESTARTS, description="Most sets per pose.")
    taper: bool = Field(
        default=False,
        description="Later starts are for poses with few sets: with each further share of the starts a pose may have "
        "one set less.",
    )
    extra_contacts: int = Field(
        default=0,
        ge=0,
        le=5,
        description="swap: contacts beyond bounds.min_contacts of sets, but for those of the first starts, at poses "
        "where fingers wrap enough for that.",
    )
    passes: int = Field(default=1, ge=1, le=64, description="Rounds over the same candidates (multi-pass generation).")
    separation: float = Field(
        default=0.12, ge=0, le=3, description="Sets of one pose with the same fingers differ by this [rad]."
    )

    @property
    def usual_contacts(self) -> bool:
        """Whether ``contacts`` are those by default, for which a hand's own stand in."""
        return self.contacts == type(self).model_fields["contacts"].default

"""Parameters of the sequence stage."""

from pydantic import Field, model_validator

from lgrasp.choices import Method, Policy
from lgrasp.config import Params
from lgrasp.sequence.optimiser.params import OptimiserParams


class SequenceParams(Params):
    """How sequences of grasps grow, object by object."""

    method: Method = Field(
        "field",
        description="field: the contact field proposes; anneal, mala: the published optimiser, true Langevin; "
        "diffuser: a trained network (lgrasp sample).",
    )
    policy: Policy = Field(
        "uniform",
        description="Opposition space of a step: any that is left; or those, and grasps, that leave most for later.",
    )
    width: int = Field(320, ge=1, le=65_536, description="Sequences started in a round.")
    wave: int = Field(
        256, ge=1, le=65_536, description="Candidates tried with one space before the next is tried (field, diffuser)."
    )
    waves: int = Field(4, ge=1, le=256, description="Waves of a step before a sequence is given up.")
    draws: int = Field(10, ge=1, le=1000, description="Steps in which a network takes the noise out (diffuser).")
    refined: bool = Field(
        True,
        description="Draws of a network are moved onto the surfaces and searched on; false: one draw of each sequence, "
        "as it comes (diffuser).",
    )
    branch: int = Field(1, ge=1, le=1024, description="Largest number of continuations of one sequence.")
    optimiser: OptimiserParams = Field(
        default_factory=lambda: OptimiserParams.model_validate({}),
        description="Numbers of the methods anneal and mala.",
    )
    rounds: int = Field(64, ge=1, le=65_536, description="Rounds per width of requested sequences before giving up.")

    @property
    def tries(self) -> int:
        """Largest number of candidates that continue a sequence in a step."""
        return self.wave * self.waves

    @property
    def in_waves(self) -> bool:
        """True if candidates are tried wave by wave, else each sequence gets one grasp a step."""
        return self.method == "field" or (self.method == "diffuser" and self.refined)

    @model_validator(mode="after")
    def _numbers_fit(self) -> "SequenceParams":
        if self.width * self.tries > 2**24:
            raise ValueError(f"width * wave * waves = {self.width * self.tries}, at most 2^24 candidates have numbers")
        return self

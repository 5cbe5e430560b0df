"""Parameters of the sequence stage."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field

__all__ = ["SequenceParams"]


class SequenceParams(BaseModel):
    """How sequences of grasps grow, object by object."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    method: Literal["field", "anneal", "mala"] = Field(
        "field", description="field: the contact field proposes; anneal, mala: the published optimiser, true Langevin."
    )
    policy: Literal["uniform", "lookahead"] = Field(
        "uniform",
        description="Opposition space of a step: any that is left; or those, and grasps, that leave most for later.",
    )
    width: int = Field(256, ge=1, le=65_536, description="Sequences begun in a round.")
    tries: int = Field(256, ge=1, le=65_536, description="Candidates that go on from a sequence in each step (field).")
    branch: int = Field(1, ge=1, le=1024, description="Most sequences that go on from one.")
    rounds: int = Field(64, ge=1, le=65_536, description="Rounds per width of sequences asked, before giving up.")

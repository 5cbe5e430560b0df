"""Parameters of the validate stage."""

from pydantic import BaseModel, ConfigDict, Field, field_validator

from lgrasp.simulate.protocol import PROTOCOLS


class ValidateParams(BaseModel):
    """Which physics protocol a grasp must pass."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    protocol: str = Field("fc", description="Named protocol that every grasp must pass.")

    @field_validator("protocol")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in PROTOCOLS:
            raise ValueError(f"unknown protocol '{name}'; choose {', '.join(PROTOCOLS)}")
        return name

"""Parameters of the simulate stage."""

from pydantic import Field, field_validator

from lgrasp.config import Params
from lgrasp.simulate.protocol import PROTOCOLS


class SimulateParams(Params):
    """Under which protocol a grasp must hold."""

    protocol: str = Field(default="fc", description="Named protocol under which every grasp must hold.")

    @field_validator("protocol")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in PROTOCOLS:
            raise ValueError(f"unknown protocol '{name}'; choose {', '.join(PROTOCOLS)}")
        return name

"""Parameters of the filter stage."""

from typing import Literal

from pydantic import Field

from lgrasp.config import Params


class FilterParams(Params):
    """How contact sets are finished; the bounds of a finished grasp are under ``bounds`` of the pipeline."""

    draws: int = Field(default=12, ge=1, le=1000, description="Postures tried for each unused finger.")
    contacts: Literal["chosen", "all"] = Field(
        default="chosen",
        description="chosen: those that search combined; all: also one of each further link that touches.",
    )

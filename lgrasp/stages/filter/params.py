"""Parameters of the filter stage."""

from pydantic import Field

from lgrasp.config import Params


class FilterParams(Params):
    """How contact sets are finished; what a finished grasp must satisfy stands under ``bounds`` of the pipeline."""

    draws: int = Field(12, ge=1, le=1000, description="Postures tried for each unused finger.")

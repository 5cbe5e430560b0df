"""Parameters of a refinement from the few options of a command line."""

from lgrasp.config import parse_model
from lgrasp.refine.params import LocalSearch
from lgrasp.stages.refine.params import RefineParams

COARSE = LocalSearch(outer=13, shift=0.0015, turn=0.015, bend=0.02, reach=0.05, reach_end=0.03)
"""For poses as a network predicts them: off by centimetres."""


def refine_params(*, outer: int | None = None, inner: int | None = None, coarse: bool = False) -> RefineParams:
    """The stage's parameters, or those for coarse poses, with other numbers of steps.

    Raises:
        ConfigError: a value out of range.
    """
    changes = {name: value for name, value in (("outer", outer), ("inner", inner)) if value is not None}
    search = COARSE.model_dump() if coarse else {}
    return parse_model(RefineParams, search | changes, "refine")

"""Parameters of a refinement from the few options of a command line."""

from collections.abc import Sequence
from typing import Any, cast

from lgrasp.config import apply_settings, parse_model
from lgrasp.planning.planner import PlanParams
from lgrasp.refine.params import LocalSearch
from lgrasp.stages.refine.params import RefineParams

COARSE = LocalSearch(matching_rounds=13, reach=0.05, reach_end=0.03)
"""For poses as a network predicts them: off by centimetres."""


def refine_params(*, coarse: bool = False, **options: int | None) -> RefineParams:
    """The stage's parameters, or those for coarse poses, with the options that are given (not None) in their place.

    Raises:
        ConfigError: a value out of range.
    """
    given = parse_model(LocalSearch, {name: value for name, value in options.items() if value is not None}, "refine")
    search = COARSE.model_dump() if coarse else {}
    return parse_model(RefineParams, search | given.model_dump(exclude_unset=True), "refine")


def plan_params(settings: Sequence[str] = (), **options: float) -> PlanParams:
    """Parameters of plans.

    Args:
        settings: ``PART.KEY=VALUE`` each; a part is ``bounds``, ``search`` or ``plan``.
        options: fields of :class:`PlanParams`.

    Raises:
        ConfigError: an unknown key, or a value out of range.
    """
    params = parse_model(PlanParams, options, "plan")
    parts: dict[str, Any] = {"bounds": params.bounds, "search": params.search, "plan": params}
    made = apply_settings(parts, settings, "lgrasp plan")
    return cast(PlanParams, made["plan"]).model_copy(update={"bounds": made["bounds"], "search": made["search"]})

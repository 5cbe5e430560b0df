"""Names of the release before that pipelines are still read by, each with a notice."""

from collections.abc import Mapping, Sequence
from typing import Any

from lgrasp.errors import ConfigError
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.notices import notice

ALIASES = {"firm": "robust"}
"""Old name of a pipeline -> its name."""

STAGE_ALIASES = {"validate": "simulate"}
"""Old name of a stage -> its name."""

_MEASURES = {"friction": "friction", "torque_scale": "torque_scale", "disturbance": "max_unresisted_load"}
_CHECKS = _MEASURES | {
    "penetration": "max_penetration",
    "self_margin": "min_self_distance",
    "apart": "min_object_distance",
    "gap": "max_gap",
    "angle": "max_normal_angle",
    "fold": "max_normal_spread",
    "balance": "max_gswo",
    "slack": "allowed_penetration",
    "open_distance": "pregrasp_distance",
    "open_margin": "min_pregrasp_distance",
    "squeeze_force": "squeeze_force",
    "stiffness": "squeeze_stiffness",
}
BOUNDS_OF_STAGES: dict[str, dict[str, str]] = {
    "place": {"clearance": "allowed_penetration", "apart": "min_object_distance"},
    "ik": {"slack": "allowed_penetration", "self_margin": "min_self_distance"},
    "search": _MEASURES | {"margin": "min_self_distance"},
    "refine": _CHECKS,
    "filter": _CHECKS,
}
"""Stage -> key that it had -> key under ``bounds``; where two stages differ, what the later line says holds."""


def stage_name(name: str, where: str) -> str:
    """The name of a stage that may be given by its old one, with a notice then."""
    if name in STAGE_ALIASES:
        notice(f"{where}: stage '{name}' is now '{STAGE_ALIASES[name]}'; the old name works in this release only")
    return STAGE_ALIASES.get(name, name)


def move_to_bounds(
    bounds: Mapping[str, Any], stages: Sequence[Mapping[str, Mapping[str, Any] | None]], where: str
) -> dict[str, Any]:
    """``bounds`` and ``stages`` of a pipeline whose stages may still have bounds of their own, moved to ``bounds``.

    Raises:
        ConfigError: a bound is given in both places.
    """
    found: dict[str, Any] = {}
    rest = [{name: dict(params or {}) for name, params in entry.items()} for entry in stages]
    for stage, keys in BOUNDS_OF_STAGES.items():
        for entry in rest:
            own = entry.get(stage, {})
            for old in [key for key in own if key in keys]:
                name = keys[old]
                if name in bounds:
                    raise ConfigError(f"{where}: '{old}' of stage {stage} is 'bounds.{name}' now: give one of them")
                notice(
                    f"{where}: '{old}' of stage {stage} is now 'bounds.{name}', for all stages; it works there in "
                    "this release only"
                )
                found[name] = own.pop(old)
    made = {**bounds, **found}
    for entry in rest:
        if "balance" in (own := entry.get("search", {})):
            notice(
                f"{where}: 'balance' of stage search is now 'gswo_share', over bounds.max_gswo; the old key works in "
                "this release only"
            )
            limit = made.get("max_gswo", GraspBounds.model_fields["max_gswo"].default)
            own["gswo_share"] = own.pop("balance") / limit
    return {"bounds": made, "stages": rest}

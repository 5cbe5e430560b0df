"""How the run of a shard differs from the one that is requested, in a few words."""

import json
from collections.abc import Mapping
from typing import Any

from lgrasp.dataset.difference import NO_REASON, leaves, tell_difference
from lgrasp.steer.params import ApproachCone

_LAST = ("object", "objects")  # a path may differ though the file is the same
_OPTIONAL = ("steer.", "negatives", "hand.contact_links")  # stored only where they ask for something
_CONE, _ANGLE = "steer.approach.direction", "steer.approach.angle"


def config_difference(there: Mapping[str, Any], requested: Mapping[str, Any]) -> str:
    """``pipeline: swift there, robust requested`` of the configs of two shards; "" if they do not differ."""
    if (version := requested.get("version")) and there.get("version") != version:
        return "by another version of lgrasp"
    old, new = _values(there), _values(requested)
    common = old.keys() & new.keys()
    names = [name for name in new | old if (name in common or _is_optional(name)) and name not in NO_REASON]
    if old.get("pipeline") != new.get("pipeline") and "pipeline" in common:  # which has other parameters, of course
        names = ["pipeline"]
    names.sort(key=lambda name: name in _LAST)
    return tell_difference(old, new, names)


def text_difference(there: str, requested: str) -> str:
    """The same of settings that are stored as JSON; of those that cannot be read "unknown there"."""
    if there == requested:
        return ""
    try:
        return config_difference(json.loads(there), json.loads(requested)) or "unknown there"
    except (ValueError, AttributeError, TypeError, RecursionError):
        return "unknown there"


def _values(config: Mapping[str, Any]) -> dict[str, str]:
    """Texts of the values of a config by name."""
    found = dict(leaves(config))
    if _CONE in found:
        found.setdefault(_ANGLE, str(ApproachCone.model_fields["angle"].default))
    return found


def _is_optional(name: str) -> bool:
    return name.startswith(_OPTIONAL) and not name.endswith(".version")

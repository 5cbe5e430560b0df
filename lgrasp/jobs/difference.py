"""How the run of a shard differs from the one that is requested, in a few words."""

from collections.abc import Iterator, Mapping
from typing import Any

from lgrasp.steer.params import ApproachCone

_NAMES = {"name": "pipeline", "shard_rows": "--shard-rows", "physics": "--simulate", "scales": "scale"}
_NO_REASON = {"run_key", "reuse", "order"}  # parts of a config that decide nothing, or say nothing to a user
_UNNAMED = ("", "pipeline", "stages", "numbers")  # levels of a config that names leave out
_LAST = ("object", "objects")  # a path may differ though the file is the same
_OPTIONAL = ("steer.", "negatives", "hand.contact_links")  # stored only where they ask for something
_CONE, _ANGLE = "steer.approach.direction", "steer.approach.angle"
_MOST_SHOWN, _MOST_LETTERS, _DEEPEST = 3, 60, 6


def config_difference(there: Mapping[str, Any], requested: Mapping[str, Any]) -> str:
    """``pipeline: swift there, robust requested`` of the configs of two shards; "" if they do not differ."""
    old, new = _values(there), _values(requested)
    common = old.keys() & new.keys()
    names = [name for name in new | old if name in common or _is_optional(name)]
    names = [name for name in names if old.get(name) != new.get(name) and name not in _NO_REASON]
    if "pipeline" in names:  # which has other parameters, of course
        names = ["pipeline"]
    names.sort(key=lambda name: name in _LAST)
    words = (_words(name, old.get(name, "not given"), new.get(name, "not")) for name in names[:_MOST_SHOWN])
    more = len(names) - _MOST_SHOWN
    return ", ".join([*words, *([f"{more} more"] if more > 0 else [])])


def _words(name: str, old: str, new: str) -> str:
    return f"{name} differs" if max(len(old), len(new)) > _MOST_LETTERS else f"{name}: {old} there, {new} requested"


def _values(config: Mapping[str, Any]) -> dict[str, str]:
    """Texts of the values of a config by name."""
    found = dict(_leaves(config))
    if _CONE in found:
        found.setdefault(_ANGLE, str(ApproachCone.model_fields["angle"].default))
    return found


def _is_optional(name: str) -> bool:
    return name.startswith(_OPTIONAL) and not name.endswith(".version")


def _leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Names and texts of the values of a config: ``seed``, ``search.restarts``, ``bounds.friction``, ..."""
    if name.count(".") > _DEEPEST:
        return
    if isinstance(value, Mapping):
        for key, below in value.items():
            path = key if name in _UNNAMED else name if key in _UNNAMED else f"{name}.{key}"
            yield from _leaves(below, path)
    elif isinstance(value, list) and any(isinstance(below, Mapping) for below in value):
        for below in value:
            yield from _leaves(below, name)
    else:
        text = str(value)
        yield _NAMES.get(name, name), text if text.isprintable() else ascii(text)

"""How the run of a shard differs from the one that is requested, in a few words."""

import itertools
from collections.abc import Iterator, Mapping
from typing import Any

_NAMES = {"name": "pipeline", "shard_rows": "--shard-rows", "physics": "--simulate", "scales": "scale"}
_NO_REASON = {"run_key", "reuse", "order"}  # parts of a config that decide nothing, or say nothing to a user
_UNNAMED = ("", "pipeline", "stages", "numbers")  # levels of a config that names leave out
_LAST = ("object", "objects")  # a path may differ though the file is the same
_MOST_SHOWN, _MOST_LETTERS, _DEEPEST = 3, 60, 6


def config_difference(there: Mapping[str, Any], requested: Mapping[str, Any]) -> str:
    """``pipeline: swift there, robust requested`` of the configs of two shards; "" if they do not differ."""
    old, new = dict(_leaves(there)), dict(_leaves(requested))
    names = [name for name in new if name in old and new[name] != old[name] and name not in _NO_REASON]
    if "pipeline" in names:  # which has other parameters, of course
        names = ["pipeline"]
    names.sort(key=lambda name: name in _LAST)
    words = (_words(name, old[name], new[name]) for name in itertools.islice(names, _MOST_SHOWN))
    more = len(names) - _MOST_SHOWN
    return ", ".join([*words, *([f"{more} more"] if more > 0 else [])])


def _words(name: str, old: str, new: str) -> str:
    return f"{name} differs" if max(len(old), len(new)) > _MOST_LETTERS else f"{name}: {old} there, {new} requested"


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

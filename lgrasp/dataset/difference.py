"""How nested values differ, such as the configs of two shards, in a few words."""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

NO_REASON = {"run_key", "reuse", "order"}
"""Parts of a config that decide nothing, or say nothing to a user."""

_NAMES = {"name": "pipeline", "shard_rows": "--shard-rows", "physics": "--simulate", "scales": "scale"}
_UNNAMED = ("", "pipeline", "stages", "numbers")  # levels of a config that names leave out
_MOST_SHOWN, _MOST_LETTERS, _DEEPEST = 3, 60, 6


def tell_difference(
    old: Mapping[str, str],
    new: Mapping[str, str],
    names: Iterable[str],
    sides: tuple[str, str] = ("there", "requested"),
    absent: tuple[str, str] = ("not given", "not"),
) -> str:
    """``seed: 0 there, 5 requested`` for the first of the names whose texts differ; "" if none do."""
    names = [name for name in names if old.get(name) != new.get(name)]
    words = []
    for name in names[:_MOST_SHOWN]:
        pair = old.get(name, absent[0]), new.get(name, absent[1])
        shown = f"{name}: {pair[0]} {sides[0]}, {pair[1]} {sides[1]}"
        words.append(shown if max(map(len, pair)) <= _MOST_LETTERS else f"{name} differs")
    more = len(names) - _MOST_SHOWN
    return ", ".join([*words, *([f"{more} more"] if more > 0 else [])])


def leaves(value: Any, name: str = "") -> Iterator[tuple[str, str]]:
    """Names and texts of the values of a config: ``seed``, ``search.restarts``, ``bounds.friction``, ..."""
    if name.count(".") > _DEEPEST:
        return
    if isinstance(value, Mapping):
        for key, below in value.items():
            path = key if name in _UNNAMED else name if key in _UNNAMED else f"{name}.{key}"
            yield from leaves(below, path)
    elif isinstance(value, list) and any(isinstance(below, Mapping) for below in value):
        for below in value:
            yield from leaves(below, name)
    else:
        text = str(value)
        yield _NAMES.get(name, name), text if text.isprintable() else ascii(text)

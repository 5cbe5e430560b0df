"""Numbers and names as reports say them."""

from collections.abc import Sequence


def number(value: float | None, form: str = ",.0f", unit: str = "") -> str:
    """A number as text, ``-`` for None."""
    return "-" if value is None else f"{value:{form}}{unit}"


def plural(n: int, what: str) -> str:
    """A number of things: ``1 shard``, ``2 shards``."""
    return f"{n:,} {what}{'' if n == 1 else 's'}"


def listed(names: Sequence[str], most: int) -> str:
    """The first of some names, and how many more there are."""
    return ", ".join(names[:most]) + (f" and {len(names) - most:,} more" if len(names) > most else "")

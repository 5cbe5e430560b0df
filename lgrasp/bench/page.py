"""Pages of benchmarks: tables compared with published figures, and the differences between the measurements."""

from typing import Any, NamedTuple

from lgrasp.config import Params, parse_model, read_yaml
from lgrasp.errors import ConfigError
from lgrasp.paths import data_dirs
from lgrasp.words import number


class Published(Params):
    """Figures that a paper prints: configs/published/NAME.yaml."""

    source: str
    """Where they are printed."""
    device: str
    """What they were measured on."""
    differs: tuple[str, ...] = ()
    """What keeps them from being compared as they stand, a line each."""
    figures: dict[str, Any]


class Table(NamedTuple):
    """A table of texts."""

    title: str
    columns: tuple[str, ...]
    rows: list[tuple[str, ...]]
    texts: int = 1
    """Columns at the left that are not numbers."""


class Page(NamedTuple):
    """A report: lines, tables, lines."""

    head: list[str]
    tables: list[Table]
    notes: list[str]


def load_published(name: str) -> Published:
    """Published figures by name.

    Raises:
        ConfigError: no such file, or a wrong key in it.
    """
    files = [folder / "published" / f"{name}.yaml" for folder in data_dirs("configs")]
    path = next((file for file in files if file.is_file()), None)
    if path is None:
        raise ConfigError(f"no published figures '{name}'; looked for {' and '.join(map(str, files))}")
    return parse_model(Published, read_yaml(path), f"published figures {path}")


def check_once(what: str, names: list[str]) -> None:
    """Raises ConfigError if one of the names of things that are measured is given twice."""
    if twice := [name for name in names if names.count(name) > 1]:
        raise ConfigError(f"bench: {what} '{twice[0]}' is named twice; each needs a name of its own")


def caveats(published: dict[str, Any]) -> list[str]:
    """The lines below a comparison: the source, its machine, and the differences."""
    lines = [f"published: {published['source']}, on {published['device']}; what differs:"]
    return [*lines, *(f"- {line}" for line in published["differs"])]


def over(a: float | None, b: float | None) -> float | None:
    """a / b, None where one is missing or b is 0."""
    return a / b if a is not None and b else None


def times(ratio: float | None) -> str:
    """A ratio as text: one decimal below 100."""
    return number(ratio, ",.1f" if ratio is not None and ratio < 100 else ",.0f")

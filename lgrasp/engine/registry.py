"""The stages there are, by name; the code of a stage is imported when it is asked for."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from itertools import combinations
from typing import Any

from pydantic import BaseModel

from lgrasp.errors import ConfigError


@dataclass(frozen=True)
class Stage:
    """A stage: ``run(table, params, context) -> (table, counts)``, in a package with ``stage.py`` and ``params.py``."""

    name: str
    package: str

    @property
    def params(self) -> type[BaseModel]:
        """The model of its parameters, ``NameParams``."""
        return getattr(import_module(f"{self.package}.params"), f"{self.name.capitalize()}Params")

    @property
    def module(self) -> str:
        """Where its function is."""
        return f"{self.package}.stage"

    @property
    def version(self) -> int:
        """Raised whenever it gives other tables; part of every content key."""
        return import_module(self.module).VERSION

    @property
    def run(self) -> Callable[..., tuple[Any, Mapping[str, int]]]:
        """The function."""
        return import_module(self.module).run


_STAGES = "place domain ik wrap close search adjust filter refine hold simulate"
STAGES: dict[str, Stage] = {name: Stage(name, f"lgrasp.stages.{name}") for name in _STAGES.split()}

SEQUENCE = Stage("sequence", "lgrasp.sequence")
"""How a pipeline continues with the next object: not a stage of one object, but with its own parameters and version."""

ORDERS = (
    ("place", "domain", "ik", "search", "filter"),
    ("place", "domain", "ik", "wrap", "search", "filter"),
    ("place", "close", "search", "filter"),
    ("place", "domain", "ik", "wrap", "close", "search", "filter"),
    ("place", "domain", "search", "adjust", "filter"),
    ("place", "domain", "search", "ik", "filter"),
    ("place", "domain", "ik", "search", "adjust", "filter"),
)
"""Accepted orders: contacts realised before they are combined, fingers perhaps wrapped, or closed; or after, by object
and fingers together, or (the published order) finger by finger. Of ik and adjust, or close, a job leaves the one that
suits its hand."""

OPTIONAL = ("refine", "hold", "simulate")
"""Stages that may follow, in this order: grasps are refined, tried, simulated."""

_ENDS = [end for n in range(len(OPTIONAL) + 1) for end in combinations(OPTIONAL, n)]


def check_order(names: tuple[str, ...], where: str) -> None:
    """Raises ConfigError unless ``names`` is one of ORDERS, perhaps with some of OPTIONAL after it."""
    if names not in [(*order, *end) for order in ORDERS for end in _ENDS]:
        choices = " or ".join(", ".join(order) for order in ORDERS)
        ends = " or ".join(", ".join(end) for end in _ENDS if end)
        raise ConfigError(f"{where}: stages {', '.join(names)}; accepted: {choices}, each with {ends} after it or not")

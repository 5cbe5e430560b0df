"""The stages there are: name -> parameters, version and function."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from pydantic import BaseModel

from lgrasp.errors import ConfigError
from lgrasp.sequence.params import SequenceParams
from lgrasp.stages.domain.params import DomainParams
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.ik.params import IkParams
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.refine.params import RefineParams
from lgrasp.stages.search.params import SearchParams
from lgrasp.stages.simulate.params import ValidateParams


@dataclass(frozen=True)
class Stage:
    """A stage; its module, with its kernels, is imported when it is first used."""

    name: str
    params: type[BaseModel]
    module: str

    @property
    def version(self) -> int:
        """Raised whenever the stage gives other results."""
        return import_module(self.module).VERSION

    @property
    def run(self) -> Callable[..., tuple[Any, Mapping[str, int]]]:
        """``run(inputs, params, context) -> (table, counts)``."""
        return import_module(self.module).run


STAGES: dict[str, Stage] = {
    stage.name: stage
    for stage in (
        Stage("place", PlaceParams, "lgrasp.stages.place.stage"),
        Stage("domain", DomainParams, "lgrasp.stages.domain.stage"),
        Stage("ik", IkParams, "lgrasp.stages.ik.stage"),
        Stage("search", SearchParams, "lgrasp.stages.search.stage"),
        Stage("filter", FilterParams, "lgrasp.stages.filter.stage"),
        Stage("refine", RefineParams, "lgrasp.stages.refine.stage"),
        Stage("sequence", SequenceParams, "lgrasp.sequence.stage"),
        Stage("validate", ValidateParams, "lgrasp.stages.simulate.stage"),
    )
}

ORDERS = (("place", "domain", "ik", "search", "filter"), ("place", "domain", "search", "ik", "filter"))
"""Accepted orders: contacts realised before they are combined, or (the published order) after."""

OPTIONAL = ("refine", "sequence", "validate")
"""Stages that may follow: grasps are refined, sequences go on with the next object, other grasps are simulated."""

_ENDS = ((), ("refine",), ("sequence",), ("validate",), ("refine", "validate"))


def check_order(names: tuple[str, ...], where: str) -> None:
    """Raises ConfigError unless ``names`` is one of ORDERS, perhaps with some of OPTIONAL after it."""
    if names not in [(*order, *end) for order in ORDERS for end in _ENDS]:
        choices = " or ".join(", ".join(order) for order in ORDERS)
        ends = " or ".join(", ".join(end) for end in _ENDS if end)
        raise ConfigError(f"{where}: stages {', '.join(names)}; accepted: {choices}, each with {ends} after it or not")

"""The stages there are: name -> parameters, version and function."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from lgrasp.errors import ConfigError
from lgrasp.sequence import stage as sequence
from lgrasp.sequence.params import SequenceParams
from lgrasp.stages.domain import stage as domain
from lgrasp.stages.domain.params import DomainParams
from lgrasp.stages.filter import stage as filter_
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.ik import stage as ik
from lgrasp.stages.ik.params import IkParams
from lgrasp.stages.place import stage as place
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.refine import stage as refine
from lgrasp.stages.refine.params import RefineParams
from lgrasp.stages.search import stage as search
from lgrasp.stages.search.params import SearchParams
from lgrasp.stages.simulate import stage as validate
from lgrasp.stages.simulate.params import ValidateParams


@dataclass(frozen=True)
class Stage:
    """A stage: ``run(inputs, params, context) -> (table, counts)``."""

    name: str
    params: type[BaseModel]
    version: int
    run: Callable[..., tuple[Any, Mapping[str, int]]]


STAGES: dict[str, Stage] = {
    "place": Stage("place", PlaceParams, place.VERSION, place.run),
    "domain": Stage("domain", DomainParams, domain.VERSION, domain.run),
    "ik": Stage("ik", IkParams, ik.VERSION, ik.run),
    "search": Stage("search", SearchParams, search.VERSION, search.run),
    "filter": Stage("filter", FilterParams, filter_.VERSION, filter_.run),
    "refine": Stage("refine", RefineParams, refine.VERSION, refine.run),
    "sequence": Stage("sequence", SequenceParams, sequence.VERSION, sequence.run),
    "validate": Stage("validate", ValidateParams, validate.VERSION, validate.run),
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

"""Fields of the parameters: one name with one description is declared once."""

import inspect
import pkgutil
from collections import defaultdict
from importlib import import_module
from typing import Annotated, get_origin

from pydantic import BaseModel

import lgrasp

ALLOWED = {
    "bounds": "a pipeline's file holds a mapping, the pipeline what is made of it",
    "object": "as bounds",
    "field": "as bounds",
    "steer": "as bounds",
    "stages": "as bounds",
    "sequence": "as bounds",
    "description": "free text of a hand, a pipeline and a config, about itself",
    "name": "of a hand and of a pipeline",
    "source": "of a hand's model and of published figures",
    "links": "of the three rules in hand.yaml, each with links of its own kind",
    "pipeline": "what a job runs, and the name of it in a list of files",
    "hand": "of jobs the name of a hand, of a pipeline a section",
    "params": "each job holds the parameters of what it runs",
}
"""Fields without a description that several models have, and why they are not one declaration."""


def _own_fields():
    """(name, description) -> models that declare the field and their annotations of it."""
    found = defaultdict(list)
    for module in pkgutil.walk_packages(lgrasp.__path__, "lgrasp."):
        for _, model in inspect.getmembers(import_module(module.name), inspect.isclass):
            if not issubclass(model, BaseModel) or model.__module__ != module.name:
                continue
            for name, annotation in inspect.get_annotations(model).items():
                if name in model.model_fields:
                    found[name, model.model_fields[name].description].append((model, annotation))
    return found


FIELDS = _own_fields()


def _repeats():
    """Fields that several models declare, each by itself: not by one shared ``Annotated`` type."""
    for (name, description), places in FIELDS.items():
        shared = get_origin(places[0][1]) is Annotated and all(a is places[0][1] for _, a in places)
        if len(places) > 1 and not shared:
            yield name, description, [model.__qualname__ for model, _ in places]


def test_a_field_with_one_description_is_declared_once():
    repeats = [r for r in _repeats() if r[1] is not None or r[0] not in ALLOWED]
    assert not repeats, repeats


def test_every_exception_is_needed():
    assert {name for name, description, _ in _repeats() if description is None} == set(ALLOWED)

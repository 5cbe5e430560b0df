"""A small pipeline of sequences, and its inputs on the CPU."""

from pathlib import Path

import pytest

from lgrasp.engine.cache import Cache
from lgrasp.engine.pipeline import Pipeline, load_pipeline
from lgrasp.jobs.sequence.inputs import SequenceInputs, load_sequence_inputs, sequence_keys
from lgrasp.runtime.device import resolve_device
from lgrasp.sequence.size import Size

OBJECTS = ("sphere", "mug")
SIZE = Size(0.06, 0.08)


def small_pipeline(name: str = "sequence", **changes: int) -> Pipeline:
    """A pipeline on a small contact field, with few sequences a round."""
    found = load_pipeline(name)
    small = found.model_copy(update={"field": found.field.model_copy(update={"records": 20_000})})
    return small.with_params("sequence", **{"width": 24, "wave": 64, "waves": 3} | changes)


def small_inputs(pipeline: Pipeline, cache_root: Path) -> SequenceInputs:
    """Allegro and the two objects."""
    keys = sequence_keys("allegro", OBJECTS, SIZE, pipeline.seed, pipeline.object, pipeline.field)
    cache = Cache(cache_root, pytest.fail)
    return load_sequence_inputs(cache, keys, pipeline.object, pipeline.field, resolve_device("cpu"))

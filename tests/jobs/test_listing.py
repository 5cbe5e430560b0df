"""What a pipeline accepts: the values told are those that it takes."""

import pytest

from lgrasp.engine.pipeline import load_pipeline
from lgrasp.errors import ConfigError
from lgrasp.jobs.listing import describe_pipeline


@pytest.mark.parametrize(
    ("name", "told", "taken", "refused"),
    [
        ("bounds.friction", "> 0, <= 2", (1e-6, 2), (0, 2.001)),
        ("bounds.max_penetration", "0 to 0.02", (0, 0.02), (-1e-9, 0.021)),
        ("field.records", "1,000 to 20,000,000", (1000, 20_000_000), (999, 20_000_001)),
        ("place.policy_proposals", "1 to 1,024", ("null", 1, 1024), (0, 1025)),
        ("search.method", "swap, mutate", ("swap", "mutate"), ("shuffle",)),
        ("ik.check_collision", "", ("true", "false"), ("perhaps",)),
    ],
)
def test_values_told_are_those_that_are_taken(name, told, taken, refused):
    accepted = {f"{part}.{key}": accepted for part, key, _, accepted, _ in describe_pipeline("robust")["parameters"]}
    assert accepted[name] == told
    pipeline = load_pipeline("robust")
    for value in taken:
        pipeline.with_settings((f"{name}={value}",))
    for value in refused:
        with pytest.raises(ConfigError):
            pipeline.with_settings((f"{name}={value}",))

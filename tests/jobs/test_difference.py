"""What is said of a run that differs from the one that is requested."""

from lgrasp.engine.pipeline import load_pipeline
from lgrasp.jobs.difference import config_difference


def config(pipeline, **more):
    return {"run_key": str(pipeline), "pipeline": pipeline.describe(), "shard_rows": 20, "object": "mug"} | more


def test_names_what_differs():
    swift, robust = load_pipeline("swift"), load_pipeline("robust")
    assert config_difference(config(swift), config(robust)) == "pipeline: swift there, robust requested"
    seeded = swift.model_copy(update={"seed": 5})
    assert config_difference(config(swift), config(seeded)) == "seed: 0 there, 5 requested"
    looser = swift.with_settings(["bounds.friction=0.8", "search.restarts=7"])
    found = config_difference(config(swift), config(looser, shard_rows=9, object="./mug.obj"))
    assert "bounds.friction: 0.5 there, 0.8 requested" in found
    assert "7 requested" in found
    assert "object" not in found
    moved = config_difference(config(swift, object="a\x1b[2J"), config(swift))
    assert moved == r"object: 'a\x1b[2J' there, mug requested"
    assert config_difference(config(swift), config(swift)) == ""

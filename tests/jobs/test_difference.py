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


def test_names_steering_that_one_side_lacks():
    """Steering is stored without its defaults; of other sections a key that is not there has its default."""
    swift = load_pipeline("swift")
    cone, wider = (config(swift.with_steering(approach=f"0,0,-1:{angle}")) for angle in (30, 40))
    assert config_difference(cone, wider) == "steer.approach.angle: 30.0 there, 40.0 requested"
    palm, fingers = config(swift.with_steering(palm="no")), config(swift.with_steering(fingers="thumb,index"))
    assert config_difference(config(swift), palm) == "steer.palm: not given there, no requested"
    assert config_difference(fingers, config(swift)) == "steer.fingers: ['thumb', 'index'] there, not requested"
    assert config_difference(config(swift), config(swift, negatives=0.5)) == "negatives: not given there, 0.5 requested"
    assert config_difference(config(swift), config(swift, later={"key": 1})) == ""

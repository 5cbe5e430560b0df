"""Inputs are made on the CPU, whatever the device of a job, so that they are the same everywhere; all else that a job
launches runs on its device."""

import traceback
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
import warp as wp
from support.places import QUICK

from lgrasp.engine.cache import Cache
from lgrasp.engine.events import JobOutcome
from lgrasp.engine.inputs import input_keys, load_inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.run import Job, run
from lgrasp.hand.find import find_hand
from lgrasp.jobs.refine.plan import PlanJob
from lgrasp.jobs.scenes.job import SceneJob
from lgrasp.planning.params import PlanParams
from lgrasp.runtime.device import Device, start
from lgrasp.runtime.kernels import PREPARING

OTHER = "other"


@pytest.fixture
def launched(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """Jobs run on a second device of Warp, which is the CPU by another name; where kernels are launched, by device."""
    from warp._src import context

    start()
    runtime = context.runtime
    monkeypatch.setitem(runtime.device_map, OTHER, context.Device(runtime, OTHER, ordinal=-1))
    # of a processor Warp asks a package that need not be there
    monkeypatch.setattr(context.Device, "free_memory", property(lambda device: 4 << 30))
    monkeypatch.setattr("lgrasp.engine.run.resolve_device", lambda name: Device(OTHER, OTHER))
    launch, found = wp.launch, {"cpu": [], OTHER: []}

    def watched(kernel, *args, **more):
        frame = next(f for f in reversed(traceback.extract_stack()) if "/lgrasp/" in f.filename)
        where = "cpu" if wp.get_device(more.get("device")) is runtime.device_map["cpu"] else OTHER
        found[where].append(f"{Path(frame.filename).name}:{frame.lineno} {kernel.module.name} {kernel.key}")
        return launch(kernel, *args, **more)

    monkeypatch.setattr(wp, "launch", watched)
    return found


def again(launched: dict[str, list[str]], job: Callable[..., Job], folder: Path) -> JobOutcome:
    """A job run twice: what it is made of is cached in the second run."""
    cache = Cache(folder / "cache", pytest.fail)
    run(job(out=folder / "first", cache=cache))
    for lines in launched.values():
        lines.clear()
    return run(job(out=folder / "second", cache=cache))


def test_plan(launched, tmp_path):
    job = partial(PlanJob, hand="barrett", object="tiny", starts=2, params=PlanParams(rolls=8, finalists=2))
    assert again(launched, job, tmp_path).rows
    assert launched["cpu"] == []
    assert launched[OTHER]


def test_scenes(launched, tmp_path):
    small = {"objects": 1, "camera": {"width": 40, "height": 30, "views": 1}}
    given = {"hand": "barrett", "objects": ["tiny"], "pipeline": QUICK, "stock": 3, "scenes": 1, "scene": small}
    job = partial(SceneJob, **given, workers=1)
    assert len(again(launched, job, tmp_path).written) == 1
    assert {line.split()[-1] for line in launched["cpu"]} == {"mesh_distance"}  # how well convex pieces fit the object
    assert launched[OTHER]


def test_inputs_are_made_on_the_cpu(launched, swift: Pipeline, tmp_path):
    keys = input_keys(find_hand("barrett"), "tiny", 1.0, swift.object, swift.field)
    cache, device = Cache(tmp_path, pytest.fail), Device(OTHER, OTHER)
    inputs = load_inputs(cache, keys, 1.0, swift.object, swift.field, device)
    assert inputs.hand.struct.pieces.body.device.alias == OTHER
    assert not any(inputs.hits.values())
    assert {line.split()[1] for line in launched["cpu"]} == set(PREPARING)
    assert launched[OTHER] == []

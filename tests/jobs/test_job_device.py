"""All kernels of a job run on its device: on a machine with a GPU, Warp need not be able to compile for the CPU, save
for pictures, which the processor draws everywhere."""

import traceback
from pathlib import Path

import pytest
import warp as wp
from support.places import QUICK

from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import input_keys, load_inputs
from lgrasp.engine.pipeline import Pipeline
from lgrasp.engine.run import run
from lgrasp.hand.find import find_hand
from lgrasp.hand.model import HandModel
from lgrasp.hand.postures import sample_bodies
from lgrasp.hand.surface_visibility import visible_surface
from lgrasp.jobs.hand_check.check import check_spaces
from lgrasp.jobs.refine.plan import PlanJob
from lgrasp.jobs.scenes.job import SceneJob
from lgrasp.planning.params import PlanParams
from lgrasp.runtime.device import Device, start

OTHER = "other"


@pytest.fixture
def on_cpu(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Jobs run on a second device of Warp, which is the processor by another name; where kernels are launched on the
    processor itself."""
    from warp._src import context

    start()
    runtime = context.runtime
    monkeypatch.setitem(runtime.device_map, OTHER, context.Device(runtime, OTHER, ordinal=-1))
    # of a processor Warp asks a package that need not be there
    monkeypatch.setattr(context.Device, "free_memory", property(lambda device: 4 << 30))
    monkeypatch.setattr("lgrasp.engine.run.resolve_device", lambda name: Device(OTHER, OTHER))
    launch, found = wp.launch, []

    def watched(kernel, *args, **more):
        if wp.get_device(more.get("device")) is runtime.device_map["cpu"]:
            frame = next(f for f in reversed(traceback.extract_stack()) if "/lgrasp/" in f.filename)
            found.append(f"{Path(frame.filename).name}:{frame.lineno} {kernel.key}")
        return launch(kernel, *args, **more)

    monkeypatch.setattr(wp, "launch", watched)
    return found


@pytest.fixture(scope="module")
def cold(tmp_path_factory: pytest.TempPathFactory) -> Cache:
    """A cache that is empty at first: hands and objects are made on the device too."""
    return Cache(tmp_path_factory.mktemp("cache"), pytest.fail)


def test_plan(on_cpu, cold, tmp_path):
    given = {"hand": "barrett", "object": "tiny", "starts": 2, "params": PlanParams(rolls=8, finalists=2)}
    outcome = run(PlanJob(**given, out=tmp_path / "out", cache=cold))
    assert outcome.rows
    assert on_cpu == []


def test_scenes(on_cpu, cold, tmp_path):
    small = {"objects": 1, "camera": {"width": 40, "height": 30, "views": 1}}
    given = {"hand": "barrett", "objects": ["tiny"], "pipeline": QUICK, "stock": 3, "scenes": 1, "scene": small}
    made = run(SceneJob(**given, out=tmp_path / "out", workers=1, cache=cold))
    assert len(made.written) == 1
    assert on_cpu == []


def test_spaces_and_palmar_side_of_a_hand(on_cpu, swift: Pipeline, cache_root):
    keys = input_keys(find_hand("allegro"), "mug", 1.0, swift.object, swift.field)
    cache, device = Cache(cache_root, pytest.fail), Device(OTHER, OTHER)
    inputs = load_inputs(cache, keys, 1.0, swift.object, swift.field, device)
    assert len(visible_surface(keys.source, inputs.hand.model, OTHER).points)
    assert len(check_spaces(inputs)) == 7
    assert on_cpu == []


def test_launches_on_the_processor_are_seen(on_cpu, inputs):
    model: HandModel = inputs.hand.model
    sample_bodies(model, model.tree.joint_open[None])
    assert any("place_bodies" in line for line in on_cpu)

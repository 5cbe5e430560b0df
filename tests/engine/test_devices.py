"""The same candidates on CPU and GPU: the same yield, mostly the same rows, and the same measures of these."""

import numpy as np
import pytest
import warp as wp

from lgrasp.engine.batch import run_batch
from lgrasp.engine.cache import Cache
from lgrasp.engine.inputs import input_keys, load_inputs
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.hand.find import find_hand
from lgrasp.jobs.hands import for_hand
from lgrasp.runtime.device import resolve_device, start

STAGES = (("place", "kept"), ("domain", "candidates"), ("ik", "kept"), ("search", "sets"), ("filter", "kept"))


@pytest.mark.parametrize(
    ("hand", "name", "mesh"),
    [
        *(("allegro", "swift", mesh) for mesh in ("mug", "sphere")),
        *(("allegro", name, "mug") for name in ("robust", "power")),
        ("barrett", "power", "mug"),
    ],
)
def test_a_gpu_makes_what_a_cpu_makes(hand, name, mesh, tmp_path):
    start()
    if wp.get_cuda_device_count() == 0:
        pytest.skip("no GPU here")
    pipeline, cache = for_hand(load_pipeline(name), hand), Cache(tmp_path)
    keys = input_keys(find_hand(hand), mesh, 1.0, pipeline.object, pipeline.field, pipeline.hand)
    found = {}
    for device in ("cpu", "cuda:0"):
        inputs = load_inputs(cache, keys, 1.0, pipeline.object, pipeline.field, resolve_device(device))
        found[device] = run_batch(pipeline, shard_context(pipeline, inputs, 0), 0, 4096)
    cpu, gpu = found["cpu"], found["cuda:0"]
    for stage, count in STAGES:
        if stage in cpu.counts:
            assert gpu.counts[stage][count] == pytest.approx(cpu.counts[stage][count], rel=0.03), stage
    # row by row where rounding does not decide: most candidates give the same poses
    at = {tuple(row): k for k, row in enumerate(np.column_stack([cpu.grasps.index, cpu.grasps.pose.round(4)]))}
    rows = [tuple(row) for row in np.column_stack([gpu.grasps.index, gpu.grasps.pose.round(4)])]
    pairs = np.array([(at[row], k) for k, row in enumerate(rows) if row in at])
    assert len(pairs) > 0.9 * len(rows)
    one, other = pairs.T
    same = np.abs(cpu.grasps.q[one] - gpu.grasps.q[other]).max(1) < 1e-4
    assert same.sum() > 20
    for metric, rounding in (("penetration", 2e-5), ("gap", 2e-5), ("pregrasp_opening", 2e-3)):
        a, b = cpu.grasps.metrics[metric][one[same]], gpu.grasps.metrics[metric][other[same]]
        assert (np.abs(a - b) < rounding).mean() > 0.98, metric

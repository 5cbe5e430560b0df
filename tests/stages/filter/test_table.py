"""place and filter: hands that are below the table of an object are refused."""

from dataclasses import replace

import numpy as np

from lgrasp.engine.batch import run_stages
from lgrasp.engine.shard import shard_context
from lgrasp.object.arrays import upload_object
from lgrasp.stages.filter.stage import run


def test_hand_below_the_table_is_refused(swift, load):
    pipeline = swift.with_table()
    inputs = load(pipeline=pipeline)
    context = shard_context(pipeline, inputs, 0)
    sets = run_stages(pipeline, context, 0, 512, "search")
    grasps, counts = run(sets, pipeline.params("filter"), context)
    assert len(grasps) == counts["kept"] > 0
    assert np.isfinite(grasps.table["approach"]).all()
    planes = inputs.object.planes.copy()
    planes[:, 3] += 1.0  # above every hand
    raised = replace(context, object=upload_object(inputs.object.model, "cpu", planes))
    refused, reasons = run(sets, pipeline.params("filter"), raised)
    assert len(refused) == reasons["kept"] == 0
    assert reasons["table"] > reasons["unused finger"] == 0
    assert sum(reasons.values()) == len(sets)
    assert set(refused.table) == {"pose", "approach"}
    assert len(run_stages(pipeline, raised, 0, 512, "place")) == 0

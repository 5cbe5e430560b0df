"""Objects are put on the palm where a policy expects grasps."""

import numpy as np

from lgrasp.engine.batch import run_batch
from lgrasp.engine.pipeline import load_pipeline
from lgrasp.engine.shard import shard_context
from lgrasp.jobs.hands import for_hand
from lgrasp.runtime.fetch import to_numpy
from lgrasp.stages.place.stage import run


def test_likely_points_of_the_palm_give_more_grasps(load):
    """Even of a single proposal a candidate; and the whole of the palm is used nevertheless."""
    one = for_hand(load_pipeline("power"), "barrett").with_params("place", policy_proposals=1, proposals=1)
    context = shard_context(one, load("capsule", one, "barrett"), 0)
    plain = context.changed(policy=None)
    rows, without = (len(run_batch(one, c, 0, 600).grasps) for c in (context, plain))
    assert rows > 2 * without > 0
    table, _ = run((0, 1024), one.params("place"), context)
    used = np.unique(table.arrays()["palm_point"])
    assert len(used) > 100
    assert np.isin(used, to_numpy(context.steered.struct.palm_points)).all()
    again, _ = run((0, 1024), one.params("place"), shard_context(one, load("capsule", one, "barrett"), 0))
    np.testing.assert_array_equal(again.arrays()["pose"], table.arrays()["pose"])

"""Verdicts of simulations, by their short names."""

import numpy as np

from lgrasp.grasp.records import GraspRows, Shard
from lgrasp.simulate.protocol import Protocol
from lgrasp.simulate.run import verdicts
from lgrasp.simulate.scene import scene_of
from lgrasp.simulate.verdict import COLUMNS, DRAWN_COLUMNS, FREE_LIFT_COLUMNS, LIFT_COLUMNS, OBJECT_COLUMNS


def judge(shard: Shard, protocol: Protocol, rows: GraspRows | None = None, **more) -> dict[str, np.ndarray]:
    """Verdicts on the rows of a shard, or on other rows; they are those that the protocol gives, and no others."""
    rows = rows or shard.grasps
    found = verdicts(scene_of(shard.hand, shard.objects), rows, protocol, **more)
    several = rows.object_index.shape[1] > 1 or protocol.success == "touches"
    columns = COLUMNS | (OBJECT_COLUMNS if several else {}) | (DRAWN_COLUMNS if protocol.draws else {})
    if protocol.lift:
        columns = LIFT_COLUMNS if protocol.table else FREE_LIFT_COLUMNS
    assert set(found) == {f"{protocol.name}_{name}" for name in columns}
    return {name.removeprefix(f"{protocol.name}_"): values for name, values in found.items()}

"""simulate: finished grasps -> those that hold their object in a physics simulation, with the verdicts."""

from dataclasses import replace

import numpy as np

from lgrasp.errors import PhysicsError
from lgrasp.grasp.rows import grasp_rows
from lgrasp.grasp.schema import PASS_SHIFT
from lgrasp.grasp.tables import GraspTable, take_grasps
from lgrasp.runtime.cores import cores
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import verdicts
from lgrasp.stages.context import Context
from lgrasp.stages.simulate.params import SimulateParams

VERSION = 4
"""Raised also whenever a named protocol's numbers or the simulated scene change."""


def run(inputs: GraspTable, params: SimulateParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Simulate every grasp and keep those that hold, in their order.

    Returns:
        The grasps with columns ``physics``, and how many were tried and held, penetrate too deep at q_pregrasp, and
        diverged.

    Raises:
        PhysicsError: MuJoCo (on a GPU, MuJoCo Warp) is missing or refuses the scene.
    """
    if context.scene is None:
        raise PhysicsError("stage simulate needs a scene")
    protocol = find_protocol(params.protocol)
    threads = 1 if context.device == "cpu" else cores()  # on the CPU, batches run side by side
    # random draws go by the numbers that rows are stored with
    named = replace(inputs, index=inputs.index + (context.salt << PASS_SHIFT))
    rows = grasp_rows(named, context.hand.model.tree, context.object.model.center, shard=context.shard)
    found = verdicts(context.scene, rows, protocol, threads=threads, device=context.device, keep=context.kept.get)
    holds = found[f"{protocol.name}_holds"]
    counts = {
        "tried": len(inputs),
        "held": int(holds.sum()),
        "too deep": int((found[f"{protocol.name}_pregrasp_penetration"] > protocol.most_penetration).sum()),
        "diverged": int(found[f"{protocol.name}_diverged"].sum()),
    }
    return take_grasps(replace(inputs, physics=found), np.flatnonzero(holds)), counts

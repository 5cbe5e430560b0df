"""hold: finished grasps -> those that hold the object in a quasi-static simulation, tried with random numbers."""

from dataclasses import replace

import numpy as np

from lgrasp.grasp.tables import GraspTable, take_grasps
from lgrasp.hold.params import HOLD_VERSION
from lgrasp.hold.run import ControlPoses, HoldTester
from lgrasp.seeding import stage_seed
from lgrasp.stages.context import Context
from lgrasp.stages.hold.params import HoldParams

VERSION = HOLD_VERSION


def run(inputs: GraspTable, params: HoldParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Try every grasp and keep those within the bound, in their order; all of them if nothing is asked for.

    Returns:
        The grasps with metrics hold_success, hold_probability and hold_drift, and how many were tried and held.
    """
    least = context.bounds.min_hold_probability
    seed = stage_seed(context.base_seed, context.shard, "hold", context.salt)
    tester = context.once("hold", lambda: HoldTester(context.hand, context.object, params), params)
    found = tester.run(ControlPoses.of(inputs), seed, least=least)
    keep = np.flatnonzero(context.bounds.held_by(found))
    table = take_grasps(replace(inputs, metrics={**inputs.metrics, **found}), keep)
    return table, {"tried": len(inputs), "held": len(keep)}

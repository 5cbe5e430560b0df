"""validate: finished grasps -> those that hold their object in a physics simulation, with the verdicts."""

import os
from dataclasses import replace

import numpy as np

from lgrasp.errors import PhysicsError
from lgrasp.grasp.records import GraspRows
from lgrasp.grasp.tables import GraspTable, take_grasps, user_poses
from lgrasp.simulate.protocol import find_protocol
from lgrasp.simulate.run import verdicts
from lgrasp.stages.context import Context
from lgrasp.stages.simulate.params import ValidateParams

VERSION = 1
"""Raised also whenever a named protocol's numbers or the simulated scene change."""


def run(inputs: GraspTable, params: ValidateParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Simulate every grasp and keep those that hold, in their order.

    Returns:
        The grasps with columns ``physics``, and how many were tried and held, penetrate too deep at q_pregrasp, and
        diverged.

    Raises:
        PhysicsError: MuJoCo is missing or refuses the scene.
    """
    if context.scene is None:
        raise PhysicsError("stage validate needs a scene")
    protocol = find_protocol(params.protocol)
    # batches run side by side on the CPU
    threads = 1 if context.device == "cpu" else os.cpu_count() or 1
    found = verdicts(context.scene, _rows(inputs, context), protocol, threads=threads)
    holds = found[f"{protocol.name}_holds"]
    counts = {
        "tried": len(inputs),
        "held": int(holds.sum()),
        "too deep": int((found[f"{protocol.name}_pregrasp_penetration"] > protocol.most_penetration).sum()),
        "diverged": int(found[f"{protocol.name}_diverged"].sum()),
    }
    return take_grasps(replace(inputs, physics=found), np.flatnonzero(holds)), counts


def _rows(table: GraspTable, context: Context) -> GraspRows:
    """The grasps as a shard would hold them."""
    tree, center = context.hand.model.tree, context.object.model.center
    return GraspRows(
        q=tree.listed_values(table.q),
        q_pregrasp=tree.listed_values(table.q_pregrasp),
        q_squeeze=tree.listed_values(table.q_squeeze),
        object_pose=user_poses(table.pose, center)[:, None],
        object_index=np.zeros((len(table), 1), np.int32),
        contact_points=(table.contact_points + center)[:, None],
        contact_normals=table.contact_normals[:, None],
        contact_links=table.contact_links[:, None].astype(np.int16),
        contact_forces=table.contact_forces[:, None],
        candidate=table.index.astype(np.uint64),
    )

"""filter: contact sets with joint positions -> finished grasps, every claim recomputed."""

import math

import numpy as np
import warp as wp

from lgrasp.grasp.context import Context
from lgrasp.grasp.tables import ContactSets, GraspTable
from lgrasp.stages.filter.kernels import METRICS, REASONS, finish_grasps
from lgrasp.stages.filter.params import FilterParams

__all__ = ["VERSION", "run"]

VERSION = 1


def run(inputs: ContactSets, params: FilterParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Fill unused fingers, check everything exactly on the final q, add control poses and metrics.

    Returns:
        The grasps in (candidate, slot) order, and the number of sets per outcome (REASONS).
    """
    d, n = context.device, len(inputs)
    dofs, width = context.hand.model.dofs, context.hand.model.groups + 1
    table, poses = inputs.candidates, inputs.candidates.poses
    outcome = wp.empty(n, dtype=wp.int32, device=d)
    q, pregrasp, squeeze = (wp.zeros((n, dofs), dtype=wp.float32, device=d) for _ in range(3))
    nothing = np.full((n, width, 3), np.nan, np.float32)
    point, normal, force = (wp.array(nothing, dtype=wp.vec3, device=d) for _ in range(3))
    link = wp.full((n, width), -1, dtype=wp.int32, device=d)
    metrics = wp.zeros((n, len(METRICS)), dtype=wp.float32, device=d)
    wp.launch(
        finish_grasps,
        dim=n,
        inputs=[
            context.hand.struct,
            context.field.struct,
            context.object.struct,
            context.seed("filter"),
            params.penetration,
            params.self_margin,
            params.gap,
            math.cos(math.radians(params.angle)),
            params.friction,
            params.balance,
            params.torque_scale,
            params.draws,
            params.slack,
            params.open_distance,
            params.press_distance,
            poses.index,
            poses.pose,
            poses.palm_point,
            poses.palm_surface,
            table.surface,
            table.record,
            table.q,
            inputs.pose,
            inputs.slot,
            inputs.chosen,
        ],
        outputs=[outcome, q, pregrasp, squeeze, point, normal, link, force, metrics],
        device=d,
    )
    code = outcome.numpy()
    keep = np.flatnonzero(code == 0)
    row = inputs.pose.numpy()[keep]
    values = metrics.numpy()[keep]
    grasps = GraspTable(
        index=poses.index.numpy()[row].astype(np.int64),
        slot=inputs.slot.numpy()[keep],
        q=q.numpy()[keep],
        q_pregrasp=pregrasp.numpy()[keep],
        q_squeeze=squeeze.numpy()[keep],
        pose=poses.pose.numpy().reshape(-1, 7)[row],
        contact_points=point.numpy()[keep],
        contact_normals=normal.numpy()[keep],
        contact_links=link.numpy()[keep],
        contact_forces=force.numpy()[keep],
        metrics={name: values[:, i] for i, name in enumerate(METRICS)},
    )
    return grasps, {reason: int((code == i).sum()) for i, reason in enumerate(REASONS)}

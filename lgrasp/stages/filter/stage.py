"""filter: contact sets with joint positions -> finished grasps, every claim recomputed."""

import math

import numpy as np
import warp as wp

from lgrasp.device.kinematics import vec_dof
from lgrasp.grasp.tables import ContactSets, GraspTable
from lgrasp.stages.context import Context
from lgrasp.stages.filter.object_kernels import deepen
from lgrasp.stages.filter.outcomes import METRICS, REASONS
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.filter.posture_kernels import fill_unused, place_used
from lgrasp.stages.filter.quality_kernels import (
    balance_grasps,
    control_poses,
    grasp_epsilon,
    pack_rows,
    self_overlap,
)

__all__ = ["VERSION", "run"]

VERSION = 3


def run(inputs: ContactSets, params: FilterParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Fill unused fingers, check everything exactly on the final q, add control poses and metrics.

    Returns:
        The grasps in (candidate, slot) order, and the number of sets per outcome (REASONS).
    """
    d, n = context.device, len(inputs)
    hand, field, obj = context.hand.struct, context.field.struct, context.object.struct
    groups, bodies = context.hand.model.groups, len(context.hand.model.piece_first) - 1
    table, poses = inputs.candidates, inputs.candidates.poses
    outcome = wp.empty(n, dtype=wp.int32, device=d)
    body = wp.empty((n, bodies - 1), dtype=wp.transform, device=d)
    posture = wp.empty((n, groups), dtype=vec_dof, device=d)
    contact, contact_surface = (wp.empty((n, groups + 1), dtype=wp.int32, device=d) for _ in range(2))
    gap, dot, fswo, gswo = (wp.empty(n, dtype=wp.float32, device=d) for _ in range(4))
    depth = wp.zeros(n, dtype=wp.float32, device=d)
    force = wp.empty((n, groups + 1), dtype=wp.vec3, device=d)
    wp.launch(
        place_used,
        dim=n,
        inputs=[
            hand,
            field,
            obj,
            params.self_margin,
            params.gap,
            math.cos(math.radians(params.angle)),
            poses.pose,
            poses.palm_point,
            poses.palm_surface,
            table.surface,
            table.record,
            table.q,
            inputs.pose,
            inputs.chosen,
        ],
        outputs=[outcome, body, posture, contact, contact_surface, gap, dot],
        device=d,
    )

    def measure(used: int) -> None:
        wp.launch(
            deepen,
            dim=(n, bodies),
            inputs=[hand, obj, params.penetration, used, poses.pose, inputs.pose, inputs.chosen, body, outcome],
            outputs=[depth],
            device=d,
        )

    measure(1)
    wp.launch(
        fill_unused,
        dim=n,
        inputs=[
            hand,
            field,
            obj,
            context.seed("filter"),
            params.penetration,
            params.draws,
            params.slack,
            params.self_margin,
            poses.index,
            poses.pose,
            poses.setting,
            inputs.pose,
            inputs.slot,
            inputs.chosen,
            depth,
        ],
        outputs=[outcome, body, posture],
        device=d,
    )
    measure(0)
    wp.launch(
        balance_grasps,
        dim=n,
        inputs=[obj, params.friction, params.balance, params.torque_scale, params.penetration, contact_surface, depth],
        outputs=[outcome, force, fswo, gswo],
        device=d,
    )
    code = outcome.numpy()
    keep = np.flatnonzero(code == 0).astype(np.int32)
    counts = {reason: int((code == i).sum()) for i, reason in enumerate(REASONS)}
    m, dofs = len(keep), context.hand.model.dofs
    row = wp.array(keep, dtype=wp.int32, device=d)
    q, pregrasp, squeeze = (wp.empty((m, dofs), dtype=wp.float32, device=d) for _ in range(3))
    wp.launch(
        control_poses,
        dim=(m, groups),
        inputs=[
            hand,
            obj,
            params.open_distance,
            params.press_distance,
            poses.pose,
            inputs.pose,
            contact,
            contact_surface,
            body,
            posture,
            row,
        ],
        outputs=[q, pregrasp, squeeze],
        device=d,
    )
    epsilon = wp.empty(m, dtype=wp.float32, device=d)
    wp.launch(
        grasp_epsilon,
        dim=m,
        inputs=[obj, context.seed("filter", 1), params.friction, contact_surface, row],
        outputs=[epsilon],
        device=d,
    )
    overlap = wp.empty(m, dtype=wp.float32, device=d)
    wp.launch(self_overlap, dim=m, inputs=[hand, body, row], outputs=[overlap], device=d)
    pose = wp.empty(m, dtype=wp.transform, device=d)
    point, normal, push = (wp.empty((m, groups + 1), dtype=wp.vec3, device=d) for _ in range(3))
    link = wp.empty((m, groups + 1), dtype=wp.int32, device=d)
    wp.launch(
        pack_rows,
        dim=m,
        inputs=[hand, obj, poses.pose, inputs.pose, contact, contact_surface, force, row],
        outputs=[pose, point, normal, link, push],
        device=d,
    )
    values = {
        "fswo": fswo.numpy()[keep],
        "gswo": gswo.numpy()[keep],
        "epsilon": epsilon.numpy(),
        "penetration": depth.numpy()[keep],
        "self_penetration": overlap.numpy(),
        "gap": gap.numpy()[keep],
        "normal_error": np.arccos(np.clip(dot.numpy()[keep], -1, 1)),
    }
    grasps = GraspTable(
        index=poses.index.numpy()[inputs.pose.numpy()[keep]].astype(np.int64),
        slot=inputs.slot.numpy()[keep],
        q=q.numpy(),
        q_pregrasp=pregrasp.numpy(),
        q_squeeze=squeeze.numpy(),
        pose=pose.numpy().reshape(-1, 7),
        contact_points=point.numpy(),
        contact_normals=normal.numpy(),
        contact_links=link.numpy(),
        contact_forces=push.numpy(),
        metrics={name: values[name] for name in METRICS},
    )
    return grasps, counts

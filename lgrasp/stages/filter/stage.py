"""filter: contact sets with joint positions -> finished grasps, every claim recomputed."""

import math
from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.grasp.tables import ContactSets, GraspTable, trim_sets
from lgrasp.math.kinematics import vec_dof
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.tally import Tally, empty_tally, read_tallies
from lgrasp.stages.context import Context
from lgrasp.stages.filter.control_kernels import control_poses, open_poses
from lgrasp.stages.filter.object_kernels import deepen, deepen_held
from lgrasp.stages.filter.outcomes import METRICS, REASONS
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.filter.posture_kernels import fill_unused, place_used
from lgrasp.stages.filter.quality_kernels import (
    balance_grasps,
    center_forces,
    count_outcomes,
    grasp_epsilon,
    list_kept,
    pack_rows,
    resist_loads,
    self_overlap,
)

VERSION = 7


def run(inputs: ContactSets, params: FilterParams, context: Context) -> tuple[GraspTable, Tally]:
    """Fill unused fingers, check everything exactly on the final q, add control poses and metrics.

    The one stage that waits for its number of rows: its tables are wide, and much fewer sets than there could be come.

    Returns:
        The grasps in (candidate, slot) order, and the number of sets per outcome (REASONS).
    """
    inputs = trim_sets(inputs)
    d, n = context.device, inputs.pose.shape[0]
    hand, field, obj = context.hand.struct, context.field.struct, context.object.struct
    groups, bodies = context.hand.model.groups, len(context.hand.model.piece_first) - 1
    table, poses = inputs.candidates, inputs.candidates.poses
    outcome = wp.empty(n, dtype=wp.int32, device=d)
    body = wp.empty((n, bodies - 1), dtype=wp.transform, device=d)
    posture = wp.empty((n, groups), dtype=vec_dof, device=d)
    contact, contact_surface = (wp.empty((n, groups + 1), dtype=wp.int32, device=d) for _ in range(2))
    numbers = wp.zeros((6, max(n, 1)), dtype=wp.float32, device=d)
    gap, dot, fswo, gswo, disturbance, depth = (numbers[i] for i in range(6))
    force = wp.empty((n, groups + 1), dtype=wp.vec3, device=d)
    wp.launch(
        place_used,
        dim=n,
        inputs=[
            hand,
            field,
            obj,
            context.held.struct,
            context.bounds.min_self_distance,
            context.bounds.max_gap,
            math.cos(math.radians(context.bounds.max_normal_angle)),
            poses.index,
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
            dim=(bodies, n),
            inputs=[
                hand,
                obj,
                context.bounds.max_penetration,
                used,
                poses.pose,
                inputs.pose,
                inputs.chosen,
                body,
                outcome,
            ],
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
            context.held.struct,
            context.seed("filter"),
            context.bounds.max_penetration,
            params.draws,
            context.bounds.allowed_penetration,
            context.bounds.min_self_distance,
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
    if context.space:
        wp.launch(
            deepen_held,
            dim=(bodies, n),
            inputs=[
                hand,
                obj,
                context.held.struct,
                context.bounds.max_penetration,
                context.bounds.min_object_distance,
                poses.index,
                poses.pose,
                inputs.pose,
                body,
                outcome,
            ],
            outputs=[depth],
            device=d,
        )
    wp.launch(
        balance_grasps,
        dim=n,
        inputs=[
            obj,
            context.bounds.friction,
            context.bounds.max_gswo,
            context.bounds.torque_scale,
            context.bounds.max_penetration,
            contact_surface,
            depth,
        ],
        outputs=[outcome, force, fswo, gswo],
        device=d,
    )
    wp.launch(
        resist_loads,
        dim=(6, n),
        inputs=[
            obj,
            context.bounds.friction,
            context.bounds.max_unresisted_load,
            poses.pose,
            inputs.pose,
            contact_surface,
            outcome,
        ],
        outputs=[disturbance],
        device=d,
    )
    tally = empty_tally(REASONS, d)
    row, upto = (wp.empty(n, dtype=wp.int32, device=d) for _ in range(2))
    wp.launch(
        count_outcomes,
        dim=n,
        inputs=[context.bounds.max_unresisted_load, disturbance],
        outputs=[outcome, upto, tally.device],
        device=d,
    )
    running_sums(upto)
    wp.launch(list_kept, dim=n, inputs=[outcome, upto], outputs=[row], device=d)
    checked = _Checked(body, posture, contact, contact_surface, force, numbers, row)
    return _kept_rows(inputs, checked, tally, params, context), tally


@dataclass(frozen=True)
class _Checked:
    """What the checks left on the device, n sets."""

    body: wp.array  # (n, bodies - 1)
    posture: wp.array  # (n, groups)
    contact: wp.array  # (n, groups + 1)
    contact_surface: wp.array  # (n, groups + 1)
    force: wp.array  # (n, groups + 1)
    numbers: wp.array  # (6, n) gap, dot of normals, fswo, gswo, disturbance, penetration
    row: wp.array  # (n,) the sets that passed first


def _kept_rows(
    inputs: ContactSets, checked: _Checked, tally: Tally, params: FilterParams, context: Context
) -> GraspTable:
    """Rows of the sets that passed: control poses, epsilon and all that is stored."""
    d, m = context.device, checked.row.shape[0]
    hand, obj = context.hand.struct, context.object.struct
    groups, dofs = context.hand.model.groups, context.hand.model.dofs
    poses, rows, row = inputs.candidates.poses, tally.device[:1], checked.row
    q, pregrasp, squeeze = (wp.empty((m, dofs), dtype=wp.float32, device=d) for _ in range(3))
    opened = wp.empty((m, groups), dtype=vec_dof, device=d)
    wp.launch(
        center_forces,
        dim=m,
        inputs=[
            obj,
            context.bounds.friction,
            context.bounds.torque_scale,
            checked.contact_surface,
            checked.numbers[3],
            rows,
            row,
        ],
        outputs=[checked.force],
        device=d,
    )
    wp.launch(
        control_poses,
        dim=(m, groups),
        inputs=[
            hand,
            obj,
            context.bounds.pregrasp_distance,
            context.bounds.squeeze_force,
            context.bounds.squeeze_stiffness,
            poses.pose,
            inputs.pose,
            checked.contact,
            checked.contact_surface,
            checked.force,
            checked.body,
            checked.posture,
            rows,
            row,
        ],
        outputs=[q, squeeze, opened],
        device=d,
    )
    wp.launch(
        open_poses,
        dim=m,
        inputs=[
            hand,
            obj,
            context.held.struct,
            context.bounds.min_pregrasp_distance,
            context.bounds.min_self_distance,
            poses.index,
            poses.pose,
            inputs.pose,
            inputs.chosen,
            checked.posture,
            opened,
            rows,
            row,
        ],
        outputs=[pregrasp],
        device=d,
    )
    epsilon, overlap = (wp.empty(m, dtype=wp.float32, device=d) for _ in range(2))
    wp.launch(
        grasp_epsilon,
        dim=m,
        inputs=[obj, context.seed("filter", 1), context.bounds.friction, checked.contact_surface, rows, row],
        outputs=[epsilon],
        device=d,
    )
    wp.launch(self_overlap, dim=m, inputs=[hand, checked.body, rows, row], outputs=[overlap], device=d)
    pose = wp.empty(m, dtype=wp.transform, device=d)
    point, normal, push = (wp.empty((m, groups + 1), dtype=wp.vec3, device=d) for _ in range(3))
    link = wp.empty((m, groups + 1), dtype=wp.int32, device=d)
    index, slot = (wp.empty(m, dtype=wp.int32, device=d) for _ in range(2))
    numbers = wp.empty((6, m), dtype=wp.float32, device=d)
    wp.launch(
        pack_rows,
        dim=m,
        inputs=[
            hand,
            obj,
            poses.pose,
            inputs.pose,
            checked.contact,
            checked.contact_surface,
            checked.force,
            poses.index,
            inputs.slot,
            checked.numbers,
            rows,
            row,
        ],
        outputs=[pose, point, normal, link, push, index, slot, numbers],
        device=d,
    )
    columns = [index, slot, q, pregrasp, squeeze, pose, point, normal, link, push, epsilon, overlap]
    *fetched, measured = read_tallies([tally], [*columns, numbers])
    kept = tally["kept"]
    fetched = [values[:kept] for values in fetched]
    gap, dot, fswo, gswo, disturbance, depth = measured[:, :kept]
    values = {
        "fswo": fswo,
        "gswo": gswo,
        "unresisted_load": disturbance,
        "epsilon": fetched[10],
        "penetration": depth,
        "self_penetration": fetched[11],
        "gap": gap,
        "normal_error": np.arccos(np.clip(dot, -1, 1)),
    }
    return GraspTable(
        index=fetched[0].astype(np.int64),
        slot=fetched[1],
        q=fetched[2],
        q_pregrasp=fetched[3],
        q_squeeze=fetched[4],
        pose=fetched[5].reshape(-1, 7),
        contact_points=fetched[6],
        contact_normals=fetched[7],
        contact_links=fetched[8],
        contact_forces=fetched[9],
        metrics={name: values[name] for name in METRICS},
    )

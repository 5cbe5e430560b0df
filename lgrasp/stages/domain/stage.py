"""domain: poses -> contacts that each finger can make there."""

import math

import warp as wp

from lgrasp.grasp.tables import CandidateTable, PoseTable
from lgrasp.math.kinematics import vec_dof
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.domain.kernels import draw_domains, draw_domains_bvh, drop_poor, keep_frozen
from lgrasp.stages.domain.params import DomainParams

VERSION = 2


def run(inputs: PoseTable, params: DomainParams, context: Context) -> tuple[CandidateTable, Tally]:
    """Contact domain of every pose and group (merged over the group's patches).

    Returns:
        The candidates, and counts ``poses``, ``rich`` (poses where enough fingers can touch), ``candidates``.
    """
    d, groups, n = context.device, context.hand.model.groups, inputs.index.shape[0]
    count = wp.zeros((n, groups), dtype=wp.int32, device=d)
    surface, record = (wp.empty((n, groups, params.keep), dtype=wp.int32, device=d) for _ in range(2))
    q = wp.empty((n, groups, params.keep), dtype=vec_dof, device=d)
    boxes = context.field.boxes
    wp.launch(
        draw_domains if boxes is None else draw_domains_bvh,
        dim=(n, groups),
        inputs=[
            context.hand.struct,
            context.field.struct,
            *([] if boxes is None else [boxes]),
            context.object.struct,
            context.seed("domain"),
            params.attempts,
            params.keep,
            math.cos(math.radians(params.angle)),
            inputs.rows,
            inputs.index,
            inputs.pose,
            inputs.setting,
            inputs.anchor,
        ],
        outputs=[count, surface, record, q],
        device=d,
    )
    if context.space:
        frozen = [context.hand.struct, context.held.struct, inputs.rows, inputs.index]
        wp.launch(keep_frozen, dim=(n, groups), inputs=frozen, outputs=[count, q], device=d)
    state = wp.zeros((n, groups, params.keep), dtype=wp.int32, device=d)
    tally = empty_tally(("poses", "rich", "candidates"), d)
    wp.launch(
        drop_poor,
        dim=n,
        inputs=[params.fingers, inputs.rows, inputs.palm_point],
        outputs=[count, tally.device],
        device=d,
    )
    return CandidateTable(inputs, count, surface, record, state, q), tally

"""domain: poses -> contacts that each finger can make there."""

import math

import warp as wp

from lgrasp.device.kinematics import vec_dof
from lgrasp.grasp.tables import CandidateTable, PoseTable
from lgrasp.stages.context import Context
from lgrasp.stages.domain.kernels import draw_domains, draw_domains_bvh
from lgrasp.stages.domain.params import DomainParams

__all__ = ["VERSION", "run"]

VERSION = 2


def run(inputs: PoseTable, params: DomainParams, context: Context) -> tuple[CandidateTable, dict[str, int]]:
    """Contact domain of every pose and group (merged over the group's patches).

    Returns:
        The candidates, and counts ``poses``, ``rich`` (poses where enough fingers can touch), ``candidates``.
    """
    d, groups, n = context.device, context.hand.model.groups, len(inputs)
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
            inputs.index,
            inputs.pose,
            inputs.setting,
            inputs.anchor,
        ],
        outputs=[count, surface, record, q],
        device=d,
    )
    state = wp.zeros((n, groups, params.keep), dtype=wp.int32, device=d)
    counts = count.numpy()
    rich = (counts > 0).sum(1) + (inputs.palm_point.numpy() >= 0) >= params.fingers
    if not rich.all():
        counts[~rich] = 0
        count = wp.array(counts, dtype=wp.int32, device=d)
    table = CandidateTable(inputs, count, surface, record, state, q)
    return table, {"poses": n, "rich": int(rich.sum()), "candidates": int(counts.sum())}

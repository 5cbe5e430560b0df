"""ik: candidates (all of them, or those chosen by sets) -> realised contacts."""

import math
from dataclasses import replace

import numpy as np
import warp as wp

from lgrasp.grasp.tables import CandidateTable, ContactSets
from lgrasp.stages.context import Context
from lgrasp.stages.ik.kernels import realise_contacts
from lgrasp.stages.ik.params import IkParams

__all__ = ["VERSION", "run"]

VERSION = 1


def run(
    inputs: CandidateTable | ContactSets, params: IkParams, context: Context
) -> tuple[CandidateTable | ContactSets, dict[str, int]]:
    """Realise contacts finger by finger.

    Candidates come back with state 1 or below 0 and the realised q. Of contact sets only the chosen candidates are
    realised, and only sets whose every contact was realised come back.

    Returns:
        The table of the kind that came in, and counts ``tried``, ``reached`` (gap and normals met), ``kept`` (clear).
    """
    sets = inputs if isinstance(inputs, ContactSets) else None
    table = inputs.candidates if isinstance(inputs, ContactSets) else inputs
    d = context.device
    shape = table.surface.shape
    if sets is None:
        wanted = wp.full(shape, 1, dtype=wp.int32, device=d)
    else:
        flags = np.zeros(shape, np.int32)
        chosen, pose = sets.chosen.numpy(), sets.pose.numpy()
        row, group = np.nonzero(chosen >= 0)
        flags[pose[row], group, chosen[row, group]] = 1
        wanted = wp.array(flags, dtype=wp.int32, device=d)
    number = wp.zeros(3, dtype=wp.int32, device=d)
    wp.launch(
        realise_contacts,
        dim=shape,
        inputs=[
            context.hand.struct,
            context.field.struct,
            context.object.struct,
            params.iterations,
            params.lever,
            params.normal_weight,
            params.damping,
            params.step,
            params.gap,
            math.cos(math.radians(params.angle)),
            params.slack,
            int(params.clearance),
            table.poses.pose,
            table.count,
            table.surface,
            table.record,
            wanted,
        ],
        outputs=[table.q, table.state, number],
        device=d,
    )
    tried, reached, clear = map(int, number.numpy())
    counts = {"tried": tried, "reached": reached, "kept": clear}
    if sets is None:
        return table, counts
    state = table.state.numpy()
    good = np.where(
        chosen >= 0, np.take_along_axis(state[pose], np.maximum(chosen, 0)[:, :, None], 2)[:, :, 0] == 1, True
    )
    keep = np.flatnonzero(good.all(1))
    kept = replace(
        sets,
        pose=wp.array(pose[keep], dtype=wp.int32, device=d),
        slot=wp.array(sets.slot.numpy()[keep], dtype=wp.int32, device=d),
        chosen=wp.array(chosen[keep], dtype=wp.int32, device=d),
        score=wp.array(sets.score.numpy()[keep], dtype=wp.float32, device=d),
    )
    return kept, counts | {"sets": len(keep)}

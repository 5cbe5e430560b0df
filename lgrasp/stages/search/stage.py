"""search: candidates -> sets of contacts that balance."""

import numpy as np
import warp as wp

from lgrasp.device.kinematics import MAX_GROUPS
from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import CandidateTable, ContactSets
from lgrasp.stages.context import Context
from lgrasp.stages.search.kernels import MAX_KEEP, keep_sets, list_usable, try_starts
from lgrasp.stages.search.params import SearchParams

__all__ = ["VERSION", "run"]

VERSION = 5

_CPU_LANES = 2
_GPU_LANES = 12


def run(
    inputs: CandidateTable, params: SearchParams, context: Context, *, realised: bool = True, salt: int = 0
) -> tuple[ContactSets, dict[str, int]]:
    """Block-wise zeroth-order search at every pose (Alg. 2).

    Args:
        realised: combine realised contacts only, and keep fingers apart; else candidates as drawn.
        salt: number of the pass over these candidates.

    Returns:
        Sets in (pose, slot) order, and counts ``poses``, ``yielding`` (poses with a set), ``sets``.
    """
    d = context.device
    n, groups, keep = inputs.surface.shape
    if groups > MAX_GROUPS or keep > MAX_KEEP:
        raise ConfigError(
            f"search: {groups} fingers with {keep} candidates; at most {MAX_GROUPS} and {MAX_KEEP} are supported"
        )
    found = wp.zeros(n, dtype=wp.int32, device=d)
    sets = wp.full((n, params.per_pose, groups), -1, dtype=wp.int32, device=d)
    score = wp.zeros((n, params.per_pose), dtype=wp.float32, device=d)
    size = wp.empty((n, groups), dtype=wp.int32, device=d)
    usable = wp.empty((n, groups, keep), dtype=wp.int32, device=d)
    wp.launch(list_usable, (n, groups), [int(realised), inputs.count, inputs.state], [size, usable], device=d)
    contacts = wp.array(params.contacts, dtype=wp.int32, device=d)
    # starts in rounds: poses that have their sets stop early, and a GPU still has enough threads
    lanes = min(params.restarts, _CPU_LANES if d == "cpu" else _GPU_LANES)
    tried = wp.empty((n, lanes, groups), dtype=wp.int32, device=d)
    tried_score = wp.empty((n, lanes), dtype=wp.float32, device=d)
    for first in range(0, params.restarts, lanes):
        wp.launch(
            try_starts,
            dim=(n, min(lanes, params.restarts - first)),
            inputs=[
                context.hand.struct,
                context.object.struct,
                context.seed("search", salt),
                first,
                contacts,
                params.friction,
                params.threshold,
                params.balance,
                params.least_force,
                params.torque_scale,
                params.moves,
                params.rounds,
                params.per_pose,
                params.margin,
                int(realised),
                int(params.score == "gswo"),
                inputs.poses.index,
                inputs.poses.palm_surface,
                inputs.surface,
                size,
                usable,
                inputs.q,
                found,
            ],
            outputs=[tried, tried_score],
            device=d,
        )
        if first + lanes > params.restarts:
            tried_score = tried_score[:, : params.restarts - first]
        wp.launch(
            keep_sets,
            dim=n,
            inputs=[groups, params.per_pose, params.separation, inputs.q, tried, tried_score],
            outputs=[found, sets, score],
            device=d,
        )
    number = found.numpy()
    pose = np.repeat(np.arange(n, dtype=np.int32), number)
    slot = (np.arange(len(pose)) - np.repeat(np.cumsum(number) - number, number)).astype(np.int32)
    table = ContactSets(
        candidates=inputs,
        pose=wp.array(pose, dtype=wp.int32, device=d),
        slot=wp.array(slot + salt * params.per_pose, dtype=wp.int32, device=d),
        chosen=wp.array(sets.numpy()[pose, slot], dtype=wp.int32, device=d),
        score=wp.array(score.numpy()[pose, slot], dtype=wp.float32, device=d),
    )
    return table, {"poses": n, "yielding": int((number > 0).sum()), "sets": len(pose)}

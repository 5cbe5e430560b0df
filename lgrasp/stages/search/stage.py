"""search: candidates -> sets of contacts that balance."""

import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.grasp.tables import CandidateTable, ContactSets
from lgrasp.math.kinematics import MAX_GROUPS
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.search.kernels import (
    MAX_KEEP,
    check_starts,
    keep_sets,
    list_hits,
    list_usable,
    take_sets,
    try_starts,
    vec_kinds,
)
from lgrasp.stages.search.params import MAX_KINDS, SearchParams

VERSION = 7

_CPU_LANES = 2
_GPU_LANES = 10


def run(inputs: CandidateTable, params: SearchParams, context: Context) -> tuple[ContactSets, Tally]:
    """Block-wise zeroth-order search at every pose (Alg. 2).

    Combines realised contacts only, and keeps fingers apart, where ik came before (``context.realised``); else
    candidates as drawn.

    Returns:
        Sets in (pose, slot) order, and counts ``poses``, ``yielding`` (poses with a set), ``sets``.
    """
    d, realised = context.device, context.realised
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
    kinds = len(params.contacts)
    contacts = vec_kinds(*params.contacts, *[0] * (MAX_KINDS - kinds))
    # starts in rounds: poses that have their sets stop early, and a GPU still has enough threads
    lanes = min(params.restarts, _CPU_LANES if d == "cpu" else _GPU_LANES)
    tried = wp.empty((n, lanes, groups), dtype=wp.int32, device=d)
    tried_score = wp.empty((n, lanes), dtype=wp.float32, device=d)
    for first in range(0, params.restarts, lanes):
        if first + lanes > params.restarts:
            tried_score = tried_score[:, : params.restarts - first]
        wp.launch(
            try_starts[params.score],
            dim=tried_score.shape,
            inputs=[
                groups,
                context.object.struct,
                context.seed("search", context.salt),
                first,
                contacts,
                kinds,
                context.bounds.friction,
                params.threshold,
                params.least_force,
                context.bounds.torque_scale,
                params.moves,
                params.rounds,
                params.per_pose,
                inputs.poses.index,
                inputs.poses.palm_surface,
                inputs.surface,
                size,
                usable,
                found,
            ],
            outputs=[tried, tried_score],
            device=d,
        )
        # the few that found a set, side by side
        hits = wp.empty(tried_score.size, dtype=wp.int32, device=d)
        number_of_hits = wp.zeros(1, dtype=wp.int32, device=d)
        wp.launch(list_hits, dim=tried_score.shape, inputs=[tried_score], outputs=[number_of_hits, hits], device=d)
        wp.launch(
            check_starts,
            dim=tried_score.size,
            inputs=[
                number_of_hits,
                hits,
                context.hand.struct,
                context.object.struct,
                context.bounds.friction,
                params.gswo_share * context.bounds.max_gswo,
                context.bounds.max_unresisted_load,
                context.bounds.torque_scale,
                context.bounds.min_self_distance,
                int(realised),
                inputs.poses.pose,
                inputs.poses.palm_surface,
                inputs.surface,
                inputs.q,
                tried,
            ],
            outputs=[tried_score],
            device=d,
        )
        wp.launch(
            keep_sets,
            dim=n,
            inputs=[groups, params.per_pose, params.separation, inputs.q, tried, tried_score],
            outputs=[found, sets, score],
            device=d,
        )
    upto = wp.clone(found)
    running_sums(upto)
    most = n * params.per_pose
    table = ContactSets(
        candidates=inputs,
        pose=wp.empty(most, dtype=wp.int32, device=d),
        slot=wp.empty(most, dtype=wp.int32, device=d),
        chosen=wp.empty((most, groups), dtype=wp.int32, device=d),
        score=wp.empty(most, dtype=wp.float32, device=d),
        rows=wp.zeros(1, dtype=wp.int32, device=d),
    )
    tally = empty_tally(("poses", "yielding", "sets"), d)
    wp.launch(
        take_sets,
        dim=n,
        inputs=[upto, inputs.poses.rows, context.salt * params.per_pose, found, sets, score],
        outputs=[table.pose, table.slot, table.chosen, table.score, table.rows, tally.device],
        device=d,
    )
    return table, tally

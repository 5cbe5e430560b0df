"""ik: candidates (all of them, or those chosen by sets) -> realised contacts."""

import math

import warp as wp

from lgrasp.grasp.tables import CandidateTable, ContactSets
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.ik.kernels import avoid_held, flag_realised, mark_chosen, realise_contacts, take_realised
from lgrasp.stages.ik.params import IkParams

VERSION = 2


def run(
    inputs: CandidateTable | ContactSets, params: IkParams, context: Context
) -> tuple[CandidateTable | ContactSets, Tally]:
    """Realise contacts finger by finger.

    Candidates come back with state 1 or below 0 and the realised q. Of contact sets only the chosen candidates are
    realised, and only sets whose every contact was realised come back.

    Returns:
        The table of the kind that came in, and counts ``tried``, ``reached`` (gap and normals met), ``kept`` (clear),
        of sets also ``sets`` (those that come back).
    """
    d = context.device
    if isinstance(inputs, CandidateTable):
        tally = empty_tally(("tried", "reached", "kept"), d)
        wanted = wp.full(inputs.surface.shape, 1, dtype=wp.int32, device=d)
        _realise(inputs, wanted, params, context, tally)
        return inputs, tally
    tally = empty_tally(("tried", "reached", "kept", "sets"), d)
    table, n = inputs.candidates, inputs.pose.shape[0]
    wanted = wp.zeros(table.surface.shape, dtype=wp.int32, device=d)
    wp.launch(mark_chosen, dim=n, inputs=[inputs.rows, inputs.pose, inputs.chosen], outputs=[wanted], device=d)
    _realise(table, wanted, params, context, tally)
    upto = wp.empty(n, dtype=wp.int32, device=d)
    flagged = [inputs.rows, inputs.pose, inputs.chosen, table.state]
    wp.launch(flag_realised, dim=n, inputs=flagged, outputs=[upto], device=d)
    running_sums(upto)
    kept = ContactSets(
        candidates=table,
        pose=wp.empty_like(inputs.pose),
        slot=wp.empty_like(inputs.slot),
        chosen=wp.empty_like(inputs.chosen),
        score=wp.empty_like(inputs.score),
        rows=wp.zeros(1, dtype=wp.int32, device=d),
    )
    wp.launch(
        take_realised,
        dim=n,
        inputs=[upto, inputs.pose, inputs.slot, inputs.chosen, inputs.score],
        outputs=[kept.pose, kept.slot, kept.chosen, kept.score, kept.rows, tally.device],
        device=d,
    )
    return kept, tally


def _realise(table: CandidateTable, wanted: wp.array, params: IkParams, context: Context, tally: Tally) -> None:
    wp.launch(
        realise_contacts,
        dim=table.surface.shape,
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
            params.touch,
            math.cos(math.radians(params.angle)),
            params.slack,
            int(params.clearance),
            context.held.struct.tries,
            context.held.struct.frozen,
            table.poses.index,
            table.poses.pose,
            table.count,
            table.surface,
            table.record,
            wanted,
        ],
        outputs=[table.q, table.state, tally.device],
        device=context.device,
    )
    if context.space:
        wp.launch(
            avoid_held,
            dim=table.surface.shape,
            inputs=[
                context.hand.struct,
                context.held.struct,
                params.apart,
                params.self_margin,
                table.poses.index,
                table.count,
                table.q,
            ],
            outputs=[table.state, tally.device],
            device=context.device,
        )

"""ik: candidates (all of them, or those chosen by sets) -> realised contacts."""

import math

import warp as wp

from lgrasp.grasp.tables import CandidateTable, ContactSets
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.structs import make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.ik.kernels import (
    IkCount,
    IkValues,
    avoid_held,
    flag_realised,
    mark_chosen,
    realise_contacts,
    take_realised,
)
from lgrasp.stages.ik.params import IkParams

VERSION = 2

_CANDIDATE_COUNTS = ("tried", "reached", "kept")  # the first of IkCount


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
        tally = empty_tally(_CANDIDATE_COUNTS, d)
        wanted = wp.full(inputs.surface.shape, 1, dtype=wp.int32, device=d)
        _realise(inputs, wanted, params, context, tally)
        return inputs, tally
    tally = empty_tally(IkCount, d)
    table, n = inputs.candidates, inputs.pose.shape[0]
    wanted = wp.zeros(table.surface.shape, dtype=wp.int32, device=d)
    wp.launch(mark_chosen, n, [inputs.struct], [wanted], device=d)
    _realise(table, wanted, params, context, tally)
    upto = wp.empty(n, dtype=wp.int32, device=d)
    wp.launch(flag_realised, n, [inputs.struct, table.struct], [upto], device=d)
    running_sums(upto)
    kept = ContactSets.empty(d, *inputs.chosen.shape, candidates=table)
    wp.launch(take_realised, n, [upto, inputs.struct], [kept.struct, tally.device], device=d)
    return kept, tally


def _realise(table: CandidateTable, wanted: wp.array, params: IkParams, context: Context, tally: Tally) -> None:
    hand, field, obj, held = context.hand.struct, context.field.struct, context.object.struct, context.held.struct
    bounds, cosine = context.bounds, math.cos(math.radians(params.angle))
    allowed = max(bounds.allowed_penetration, params.resolved_penetration)
    values = make_struct(IkValues, params, bounds, cosine=cosine, allowed_penetration=allowed)
    outputs = [table.struct, tally.device]
    asked = [hand, field, obj, held, values, wanted]
    kernel = realise_contacts[context.hand.model.tree.dof_size]
    wp.launch(kernel, table.surface.shape, asked, outputs, device=context.device)
    if context.opposed:
        wp.launch(avoid_held, table.surface.shape, [hand, held, values], outputs, device=context.device)

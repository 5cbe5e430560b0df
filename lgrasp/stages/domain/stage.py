"""domain: poses -> contacts that each finger can make there."""

import math

import warp as wp

from lgrasp.field.arrays import Boxes
from lgrasp.grasp.structs import vec_further
from lgrasp.grasp.tables import CandidateTable, PoseTable
from lgrasp.runtime.structs import make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.domain.chance_kernels import drop_unlikely, rate_contacts
from lgrasp.stages.domain.kernels import DomainCount, DomainValues, count_realised, draw_domains, drop_poor, keep_frozen
from lgrasp.stages.domain.params import DomainParams
from lgrasp.stages.domain.predicted_kernels import add_predicted

VERSION = 4


def run(inputs: PoseTable | CandidateTable, params: DomainParams, context: Context) -> tuple[CandidateTable, Tally]:
    """Contact domain of every pose and group (merged over the group's patches).

    Of candidates, once some are realised: new ones in place of those that are not, at promising poses, for groups that
    have few.

    Returns:
        The candidates, and counts ``poses``, ``rich`` (poses where enough fingers can touch), ``candidates``.
    """
    d, groups, points = context.device, context.hand.model.groups, len(context.object.model.contact_points)
    tally = empty_tally(DomainCount, d)
    cosine, stride = math.cos(math.radians(params.angle)), _stride(points)
    given = {"cosine": cosine, "stride": stride, "round": context.round, "groups": context.steered.touching.bits}
    values = make_struct(DomainValues, params, context.bounds, **given)
    if isinstance(inputs, CandidateTable):
        table = inputs
        _drop_unlikely(table, params, context)
        realised = wp.empty(table.count.shape, dtype=wp.int32, device=d)
        wp.launch(count_realised, realised.shape, [table.struct], [realised], device=d)
    else:
        n = inputs.index.shape[0]
        count, state = (wp.zeros((n, groups, params.keep)[:axes], dtype=wp.int32, device=d) for axes in (2, 3))
        none = wp.empty((0, 0, 0), dtype=vec_further, device=d)
        table = CandidateTable.empty(d, n, groups, params.keep, poses=inputs, count=count, state=state, further=none)
        realised = wp.empty((0, 0), dtype=wp.int32, device=d)
    hand, field, boxes = context.hand.struct, context.field.struct, context.field.boxes
    wp.launch(
        draw_domains["voxel" if boxes is None else "bvh"],
        dim=table.count.shape,
        inputs=[hand, field, boxes or Boxes(), context.object.struct, values, context.seed("domain"), realised],
        outputs=[table.struct],
        device=d,
    )
    if context.opposed:
        wp.launch(keep_frozen, table.count.shape, [hand, context.held.struct], [table.struct], device=d)
    if context.predicted is not None and context.round == 0:
        asked = [context.object.struct, context.held.struct, context.predicted]
        wp.launch(add_predicted, table.count.shape, [hand, *asked, params.keep], [table.struct], device=d)
    if context.round == 0:
        wp.launch(drop_poor, table.count.shape[0], [values], [table.struct, tally.device], device=d)
    return table, tally


def _drop_unlikely(table: CandidateTable, params: DomainParams, context: Context) -> None:
    """Poses lose their contacts that a policy, if there is one, finds not worth going on with."""
    if context.policy is None or context.opposed or not params.later_cost:
        return
    n, groups = table.count.shape
    chance = wp.empty(n, dtype=wp.float32, device=context.device)
    asked = [groups, context.object.struct, context.policy.contacts, table.struct]
    wp.launch(rate_contacts, n, asked, [chance], device=context.device)
    wp.launch(drop_unlikely, n, [chance, params.later_cost], [table.struct], device=context.device)


def _stride(points: int) -> int:
    """A number coprime to the number of points, near its golden section: multiples of it are spread well."""
    return next(n for n in range(max(1, round(0.618 * points)), 2 * points + 2) if math.gcd(n, points) == 1)

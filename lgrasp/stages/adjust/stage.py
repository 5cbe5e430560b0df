"""adjust: contact sets -> the same with object and fingers moved together, so that every contact is made."""

import math

import warp as wp

from lgrasp.grasp.collision import depth_slices
from lgrasp.grasp.tables import CandidateTable, ContactSets, PoseTable, trim_sets
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.adjust.depth import find_depths
from lgrasp.stages.adjust.kernels import FIRST_DEPTH, begin_sets, check_thumbs, step_sets, take_whole
from lgrasp.stages.adjust.params import AdjustParams
from lgrasp.stages.adjust.structs import AdjustCount, Adjusted, AdjustValues, Deepest, FaceContact
from lgrasp.stages.context import Context

VERSION = 1


def run(inputs: ContactSets, params: AdjustParams, context: Context) -> tuple[ContactSets, Tally]:
    """Move the object and the fingers of each set until its contacts are made.

    A finger of few joints cannot put a contact where the object happens to be: the object comes to it. Contacts stay
    where they are on the object. Waits for the number of sets.

    Returns:
        The sets whose contacts are made and whose fingers are clear of the object, each with a pose of its own, and
        counts ``tried``, ``kept``.
    """
    d, inputs = context.device, trim_sets(inputs)
    tally, n, groups = empty_tally(AdjustCount, d), inputs.pose.shape[0], context.hand.model.groups
    poses = PoseTable.empty(d, n, groups, rows=wp.full(1, n, dtype=wp.int32, device=d))
    further = wp.empty((0, 0, 0), dtype=inputs.candidates.further.dtype, device=d)
    table = CandidateTable.empty(d, n, groups, 1, poses=poses, further=further)
    kept = ContactSets.empty(d, *inputs.chosen.shape, candidates=table)
    angles = {"cosine": math.cos(math.radians(params.angle)), "object_turn": math.radians(params.object_turn)}
    values = make_struct(AdjustValues, params, context.bounds, **angles)
    hand, obj, field = context.hand.struct, context.object.struct, context.field.struct
    parts, bodies = depth_slices(d), len(context.hand.model.piece_first) - 1
    given = {"touch": wp.empty((n, groups + 1), dtype=FaceContact, device=d)}
    given["deepest"] = wp.empty((n, bodies, parts), dtype=Deepest, device=d)
    moving = empty_struct(Adjusted, d, n, **given)
    wp.launch(begin_sets, n, [field, hand, inputs.struct, inputs.candidates.struct], [table.struct, moving], device=d)
    step = step_sets[context.hand.model.tree.dof_size]
    for it in range(params.iterations + 1 if n else 0):
        if it >= int(FIRST_DEPTH):
            shape = (n, bodies, parts)
            wp.launch(find_depths, shape, [hand, obj, values, table.struct, parts], [moving], device=d)
        wp.launch(step, n, [hand, field, obj, values, it], [table.struct, moving], device=d)
    upto = wp.empty(n, dtype=wp.int32, device=d)
    wp.launch(check_thumbs, n, [hand, table.struct, moving], [upto], device=d)
    running_sums(upto)
    wp.launch(take_whole, n, [upto, inputs.struct], [kept.struct, tally.device], device=d)
    return kept, tally

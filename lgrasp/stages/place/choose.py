"""Of the poses proposed for each candidate, the best that static links do not block."""

from typing import Any

import warp as wp

from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.place.kernels import choose_poses, take_poses
from lgrasp.stages.place.structs import PlaceCount


def best_poses(proposals: Any, values: Any, first: wp.array, context: Context) -> tuple[PoseTable, Tally]:
    """The poses that can hold, in candidate order, and counts ``tried``, ``blocked`` (by static links), ``kept``.

    Args:
        proposals: struct ProposedPoses. values: struct PlaceValues.
        first: candidate of row 0, (1,).
    """
    d, (count, _, groups) = context.device, proposals.anchor.shape
    chosen, upto = (wp.empty(count, dtype=wp.int32, device=d) for _ in range(2))
    tally = empty_tally(PlaceCount, d)
    asked = [context.hand.struct, context.object.struct, values, proposals]
    wp.launch(choose_poses, count, asked, [chosen, upto, tally.device], device=d)
    running_sums(upto)
    table = PoseTable.empty(d, count, groups)
    wp.launch(take_poses, count, [upto, chosen, first, proposals], [table.struct], device=d)
    return table, tally

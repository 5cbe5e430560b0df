"""Poses -> others near them."""

import math

import warp as wp

from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.place.kernels import choose_poses, take_poses
from lgrasp.stages.place.moved_kernels import MoveValues, name_moved, propose_moved
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.place.structs import PlaceCount, PlaceValues, ProposedPoses

_DRAWS = 4  # of which the first that static links do not block is taken


def move_poses(poses: PoseTable, reach: float, angle: float, context: Context) -> PoseTable:
    """One move of each pose where the object lies on the palm, by the numbers of the context's pass.

    Args:
        reach: how far the contact of the palm moves at most [m], on the palm and on the object.
        angle: how far the object rolls on it at most [deg].

    Returns:
        Poses that static links do not block, with the numbers of the candidates that they come from.
    """
    d, n, groups = context.device, poses.index.shape[0], context.hand.model.groups
    hand, obj = context.hand.struct, context.object.struct
    proposals = empty_struct(ProposedPoses, d, n, _DRAWS, groups)
    values = make_struct(MoveValues, context.bounds, reach=reach, angle=math.radians(angle))
    asked = [hand, obj, context.steered.struct, values, poses.struct, context.seed("move", context.salt)]
    wp.launch(propose_moved, (n, _DRAWS), asked, [proposals], device=d)
    chosen, upto = (wp.empty(n, dtype=wp.int32, device=d) for _ in range(2))
    own = make_struct(PlaceValues, PlaceParams(), context.bounds)
    counts = empty_tally(PlaceCount, d).device
    wp.launch(choose_poses, n, [hand, obj, own, proposals], [chosen, upto, counts], device=d)
    running_sums(upto)
    table = PoseTable.empty(d, n, groups)
    none = wp.zeros(1, dtype=wp.int32, device=d)
    wp.launch(take_poses, n, [upto, chosen, none, proposals], [table.struct], device=d)
    wp.launch(name_moved, n, [poses.struct], [table.struct], device=d)
    return table

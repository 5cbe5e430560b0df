"""Poses near others: where few poses give grasps, those beside one that did give them far more often."""

import math

import numpy as np
import warp as wp

from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import Tally
from lgrasp.stages.context import Context
from lgrasp.stages.place.near_kernels import NearMoves, number_poses, propose_near
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.place.stage import best_poses
from lgrasp.stages.place.structs import PlaceValues, ProposedPoses

_DISTANCE = 0.015  # [m] most that an object slides, and as much that its point of the palm moves
_ANGLE = math.radians(10.0)  # standard deviation of its roll
_PROPOSALS = 4  # for each pose; the policy chooses one


def near_poses(
    parents: PoseTable, rows: np.ndarray, number: np.ndarray, params: PlaceParams, context: Context
) -> tuple[PoseTable, Tally]:
    """Poses near some of a table, on the palm as they are, and counts as of the stage.

    Args:
        parents: objects on the palm.
        rows: of the table, one for each new pose, (N,).
        number: of the new poses in the shard, (N,): it decides how each is moved.
    """
    d, groups = context.device, context.hand.model.groups
    moves = make_struct(
        NearMoves,
        parent=wp.array(rows, dtype=wp.int32, device=d),
        number=wp.array(number, dtype=wp.int32, device=d),
        distance=_DISTANCE,
        angle=_ANGLE,
    )
    shape = len(rows), _PROPOSALS
    proposals = empty_struct(ProposedPoses, d, *shape, groups)
    values = make_struct(PlaceValues, params, context.bounds)
    models = [context.hand.struct, context.field.struct, context.object.struct]
    asked = [values, context.steered.struct, context.networks.reach, parents.struct, moves, context.seed("place", 1)]
    wp.launch(propose_near, shape, [*models, *asked], [proposals], device=d)
    table, tally = best_poses(proposals, values, wp.zeros(1, dtype=wp.int32, device=d), context)
    wp.launch(number_poses, len(rows), [moves], [table.struct], device=d)
    return table, tally

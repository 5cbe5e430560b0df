"""Poses near others: those of a family."""

import math

import numpy as np
import warp as wp

from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import make_struct
from lgrasp.stages.context import Context
from lgrasp.stages.place.family_kernels import MoveValues, move_poses
from lgrasp.stages.place.params import PlaceParams


def move_table(
    table: PoseTable, index: np.ndarray, params: PlaceParams, context: Context, *, share: float = 1.0
) -> tuple[PoseTable, dict[str, int]]:
    """A pose near each of a table, without those that static links block.

    Args:
        index: numbers of the new ones, (P,), which decide how each is moved in a pass.
        share: of the moves and turns of the parameters.

    Returns:
        The poses, and counts as of the stage.
    """
    d, n = context.device, len(index)
    given = {"index": wp.array(index, dtype=wp.int32, device=d), "rows": wp.full(1, n, dtype=wp.int32, device=d)}
    moved = PoseTable.empty(d, n, context.hand.model.groups, **given)
    clear = wp.empty(n, dtype=wp.int32, device=d)
    sizes = {"family_move": share * params.family_move, "family_turn": share * math.radians(params.family_turn)}
    values = make_struct(MoveValues, context.bounds, **sizes)
    asked = [context.hand.struct, context.object.struct, values, context.seed("place", context.salt), table.struct]
    wp.launch(move_poses, n, asked, [moved.struct, clear], device=d)
    rows = np.flatnonzero(to_numpy(clear))
    kept = PoseTable(**moved.taken(rows), rows=wp.full(1, len(rows), dtype=wp.int32, device=d))
    return kept, {"tried": n, "blocked": n - len(rows), "kept": len(rows)}

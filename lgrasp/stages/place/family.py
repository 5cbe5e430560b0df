"""Families: poses about those that gave grasps, which give grasps far more often than poses drawn anywhere."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import warp as wp

from lgrasp.grasp.schema import MOVED_PASS, MOVES, PASS_SHIFT
from lgrasp.grasp.tables import GraspTable, PoseTable
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import make_struct
from lgrasp.runtime.tally import Meter
from lgrasp.seeding import mixed
from lgrasp.stages.context import Context
from lgrasp.stages.place.family_kernels import MoveValues, move_poses
from lgrasp.stages.place.params import PlaceParams

_FIRST_MOVES = 4  # of a family in its first round; twice as many in each that follows, up to MOVES
_LAST_SHARE = 0.2  # of the moves of the first round, in the last


def search_families(
    table: PoseTable,
    params: PlaceParams,
    context: Context,
    meter: Meter,
    finish: Callable[[PoseTable, Context], GraspTable],
) -> list[GraspTable]:
    """Grasps of poses about others, round by round.

    Each pose of ``table`` begins a family. Every round moves one of the poses of a family that gave grasps, as long as
    fewer than ``params.family`` did, by less than the round before: far where grasps are wherever one looks, near where
    they are not. A family depends on the pose that it began with and on no other.

    Args:
        table: poses that gave grasps.
        finish: grasps of poses, in the order of their numbers, by the stages after place.
    """
    members, parts = table.arrays(), []
    order = np.argsort(members["index"])
    members = {name: values[order] for name, values in members.items()}
    family = members["index"].astype(np.int64)
    for number in range(params.family_rounds):
        own = context.with_salt(MOVED_PASS + number)
        begin, first, count = np.unique(family, return_index=True, return_counts=True)
        going = count < params.family
        if not going.any():
            break
        begin, first, count = begin[going], first[going], count[going].astype(np.uint64)
        drawn = mixed(mixed(begin.astype(np.uint64)) + np.uint64(number)) % count
        moves = min(_FIRST_MOVES << min(number, MOVES), MOVES)
        rows = np.repeat(first + drawn.astype(np.int64), moves)
        index = (begin[:, None] * MOVES + np.arange(moves)).ravel()
        start = meter.now()
        parents = PoseTable.of({name: values[rows] for name, values in members.items()}, context.device)
        share = _LAST_SHARE ** (number / max(params.family_rounds - 1, 1))
        moved, counts = move_table(parents, index, params, own, share=share)
        meter.add("place", counts, start, meter.now())
        found = finish(moved, own)
        if not len(found.index):
            continue
        parts.append(replace(found, index=found.index + ((MOVED_PASS + number) << PASS_SHIFT)))
        new = moved.arrays()
        good = np.isin(new["index"], found.index)
        joined = np.concatenate([family, new["index"][good].astype(np.int64) // MOVES])
        order = np.argsort(joined, kind="stable")
        members = {name: np.concatenate([values, new[name][good]])[order] for name, values in members.items()}
        family = joined[order]
    return parts


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

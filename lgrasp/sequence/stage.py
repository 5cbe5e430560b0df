"""sequence: sequences and grasps of the next object -> sequences that are one object longer."""

import numpy as np

from lgrasp.grasp.sequences import SequenceTable, extend
from lgrasp.grasp.tables import GraspTable, take_grasps
from lgrasp.sequence.params import SequenceParams
from lgrasp.sequence.room import room_left
from lgrasp.stages.context import Context

VERSION = 3


def run(
    inputs: tuple[SequenceTable, GraspTable], params: SequenceParams, context: Context
) -> tuple[SequenceTable, dict[int, dict[str, int]]]:
    """Go on from sequences with grasps in their opposition spaces; other joints stay exactly where they are.

    Args:
        inputs: the sequences that the context's hand holds, one for each row of its :class:`Held`; grasps of the next
            object by candidates that continue these rows.

    Returns:
        The longer sequences by row, up to ``params.branch`` of each, with metric ``room``
        (:func:`~lgrasp.sequence.room.room_left`); and by opposition space counts ``sequences``, ``grasps``, ``held``
        (sequences that can be continued) and ``kept``.
    """
    before, grasps = inputs
    space, free = context.held.space, context.held.free
    assert space is not None
    row = grasps.index // context.held.struct.tries
    room = room_left(~before.used & ~free, grasps, row, context)
    chosen = go_on(row, room, params)
    taken = take_grasps(grasps, chosen)
    taken.metrics["room"] = room[chosen]
    posture = before.posture(context.hand.model.tree)
    table = extend(before, posture, row[chosen], space[row[chosen]], free[row[chosen]], taken)
    some = {"sequences": slice(None), "grasps": row, "held": np.unique(row), "kept": table.parent}
    spaces = np.unique(space).tolist()
    return table, {n: {name: int((space[of] == n).sum()) for name, of in some.items()} for n in spaces}


def go_on(row: np.ndarray, room: np.ndarray, params: SequenceParams) -> np.ndarray:
    """Which of several continuations of the same sequences are taken: rising indices.

    Args:
        row: sequence that each continues, (M,).
        room: room that each leaves, (M,); policy ``lookahead`` prefers the largest, ``uniform`` the first.
    """
    worth = -room if params.policy == "lookahead" else np.zeros(len(row))
    order = np.lexsort((np.arange(len(row)), worth, row))
    place = np.arange(len(row)) - np.searchsorted(row[order], row[order])
    return np.sort(order[place < params.branch])

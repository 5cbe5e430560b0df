"""sequence: sequences and grasps of the next object -> sequences that are one object longer."""

import numpy as np

from lgrasp.grasp.sequences import SequenceTable, extend
from lgrasp.grasp.tables import GraspTable, take_grasps
from lgrasp.hand.opposition.spaces import free_joints
from lgrasp.sequence.params import SequenceParams
from lgrasp.sequence.room import room_left
from lgrasp.stages.context import Context

VERSION = 1


def run(
    inputs: tuple[SequenceTable, int, GraspTable], params: SequenceParams, context: Context
) -> tuple[SequenceTable, dict[str, int]]:
    """Go on from sequences with grasps of one opposition space; other joints stay exactly where they are.

    Args:
        inputs: the sequences that the context's hand holds, one for each row of its :class:`Held`; the number of the
            opposition space; grasps of the next object by candidates that continue these rows.

    Returns:
        The longer sequences by row, up to ``params.branch`` of each, with metric ``room``
        (:func:`~lgrasp.sequence.room.room_left`); and counts ``sequences``, ``grasps``, ``held`` (sequences that
        be continued) and ``kept``.
    """
    before, number, grasps = inputs
    assert context.space is not None
    used = before.used
    free = np.array([free_joints(context.space, joints) for joints in used], bool).reshape(used.shape)
    row = grasps.index // context.held.struct.tries
    room = room_left(~used & ~free, grasps, row, context)
    chosen = go_on(row, room, params)
    taken = take_grasps(grasps, chosen)
    taken.metrics["room"] = room[chosen]
    posture = before.posture(context.hand.model.tree)
    table = extend(before, posture, row[chosen], number, free[row[chosen]], taken)
    counts = {"sequences": len(before), "grasps": len(grasps), "held": len(np.unique(row)), "kept": len(table)}
    return table, counts


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

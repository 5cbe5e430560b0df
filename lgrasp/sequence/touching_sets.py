"""Finished grasps, of an optimiser or a network, as contact sets, so that they pass the same filter as all others."""

import numpy as np

from lgrasp.grasp.predicted import TouchingGrasps, record_of_points
from lgrasp.grasp.structs import FURTHER
from lgrasp.grasp.tables import ContactSets
from lgrasp.stages.context import Context


def touching_sets(grasps: TouchingGrasps, context: Context) -> ContactSets:
    """Sets of the two contacts of each grasp; the candidate of row i is the first that continues held row i.

    Grasps whose contact point is in no record of the contact field are left out.

    Args:
        grasps: H grasps, one for each row of the context's :class:`Held` with its opposition space.
    """
    tree, held = context.hand.model.tree, context.held
    assert held.sides is not None
    groups, rows = tree.groups, len(grasps.q)
    record_of = record_of_points(context.hand.model, context.field.model)
    shape = (rows, groups, 1)
    count, surface, record = (np.zeros(s, np.int32) for s in (shape[:2], shape, shape))
    chosen = np.full((rows, groups), -1, np.int32)
    palm_point, palm_surface = (np.full(rows, -1, np.int32) for _ in range(2))
    known = ((grasps.hand_point >= 0) & (grasps.object_point >= 0)).all(1)
    posture = tree.by_group(grasps.q.astype(np.float32))[:, :, None]
    able = np.stack([held.free[:, tree.own_dofs(g)].any(1) for g in range(groups)], 1)
    for side, group in enumerate(held.sides.T):
        moves = (group >= 0) & able[np.arange(rows), group]
        palm_point[~moves] = grasps.hand_point[~moves, side]
        palm_surface[~moves] = grasps.object_point[~moves, side]
        found, g = record_of[grasps.hand_point[:, side]], group[moves]
        known &= ~moves | (found >= 0)
        count[moves, g], chosen[moves, g] = 1, 0
        surface[moves, g, 0], record[moves, g, 0] = grasps.object_point[moves, side], found[moves]
    kept = np.flatnonzero(known)
    arrays = {
        "pose": np.arange(len(kept), dtype=np.int32),
        "slot": np.zeros(len(kept), np.int32),
        "chosen": chosen[kept],
        "score": np.zeros(len(kept), np.float32),
        "candidates.count": count[kept],
        "candidates.surface": surface[kept],
        "candidates.record": record[kept],
        "candidates.state": np.ones_like(surface[kept]),
        "candidates.q": posture[kept],
        "candidates.further": np.zeros((len(kept), groups, 0, 2 * int(FURTHER)), np.int32),
        "candidates.poses.index": (kept * held.struct.tries).astype(np.int32),
        "candidates.poses.pose": grasps.pose[kept].astype(np.float32),
        "candidates.poses.palm_point": palm_point[kept],
        "candidates.poses.palm_surface": palm_surface[kept],
        "candidates.poses.setting": held.setting[kept].astype(np.int32),
        "candidates.poses.resting": np.full(len(kept), -1, np.int32),
        "candidates.poses.anchor": np.full((len(kept), groups), -1, np.int32),
    }
    return ContactSets.of(arrays, context.device)

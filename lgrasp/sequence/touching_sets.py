"""Finished grasps, of an optimiser or a network, as contact sets, so that they pass the same filter as all others."""

import numpy as np

from lgrasp.grasp.predicted import TouchingGrasps, record_of_points
from lgrasp.grasp.tables import ContactSets
from lgrasp.runtime.fetch import to_numpy
from lgrasp.stages.context import Context


def touching_sets(grasps: TouchingGrasps, free: np.ndarray, context: Context) -> ContactSets:
    """Sets of the two contacts of each grasp; the candidate of row i is the first that continues held row i.

    Grasps whose contact point is in no record of the contact field are left out.

    Args:
        grasps: H grasps with the context's opposition space, one for each row of its :class:`Held`.
        free: joints that may move, (H, K) bool.
    """
    assert context.space is not None
    tree = context.hand.model.tree
    groups, rows = tree.groups, len(grasps.q)
    record_of = record_of_points(context.hand.model, context.field.model)
    shape = (rows, groups, 1)
    count, surface, record = (np.zeros(s, np.int32) for s in (shape[:2], shape, shape))
    chosen = np.full((rows, groups), -1, np.int32)
    palm_point, palm_surface = (np.full(rows, -1, np.int32) for _ in range(2))
    known = ((grasps.hand_point >= 0) & (grasps.object_point >= 0)).all(1)
    posture = tree.by_group(grasps.q.astype(np.float32))[:, :, None]
    for side, g in enumerate(context.space.groups):
        own = tree.own_dofs(g) if g >= 0 else []
        moves = free[:, own].any(1) if g >= 0 else np.zeros(rows, bool)
        palm_point[~moves] = grasps.hand_point[~moves, side]
        palm_surface[~moves] = grasps.object_point[~moves, side]
        if g >= 0:
            found = record_of[grasps.hand_point[:, side]]
            known &= ~moves | (found >= 0)
            count[moves, g], chosen[moves, g] = 1, 0
            surface[moves, g, 0], record[moves, g, 0] = grasps.object_point[moves, side], found[moves]
    kept = np.flatnonzero(known)
    setting = np.maximum(to_numpy(context.held.struct.setting), 0)
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
        "candidates.further": np.zeros((len(kept), groups, 1, 0), np.int32),
        "candidates.poses.index": (kept * context.held.struct.tries).astype(np.int32),
        "candidates.poses.pose": grasps.pose[kept].astype(np.float32),
        "candidates.poses.palm_point": palm_point[kept],
        "candidates.poses.palm_surface": palm_surface[kept],
        "candidates.poses.setting": setting[kept].astype(np.int32),
        "candidates.poses.resting": np.full(len(kept), -1, np.int32),
        "candidates.poses.anchor": np.full((len(kept), groups), -1, np.int32),
    }
    return ContactSets.of(arrays, context.device)

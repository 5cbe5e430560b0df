"""Rows of sequences: later steps leave alone what earlier ones did, and rows extend rows of one object less."""

import numpy as np

from lgrasp.judge.shard import JudgedShard


def check_frozen(
    shard: JudgedShard, rows: np.ndarray, index: np.ndarray, link_of: np.ndarray, used: np.ndarray
) -> np.ndarray:
    """Rows (n,) whose steps move a joint that is not theirs, or that carries a link on an earlier object.

    Args:
        index: objects of the rows, shape [n, O], -1 where absent.
        link_of, used: link of every contact and whether it is one, shape [n, O, C].
    """
    steps, g = {k: v[rows] for k, v in shard.steps.items()}, shard.grasps
    present, free = index >= 0, np.asarray(steps["free_joints"], bool)  # (n, O), (n, O, K)
    bad = (present[:, 1:] & ~present[:, :-1]).any(axis=1) | (free.sum(axis=1) > 1).any(axis=1)
    bad |= (free.any(axis=2) != present).any(axis=1)
    last = np.maximum(present.sum(axis=1) - 1, 0)
    for name, held in (("q", "q"), ("q_pregrasp", "q"), ("q_squeeze", "q_squeeze")):
        still = present[:, 1:, None] & ~free[:, 1:]
        bad |= (still & (steps[name][:, 1:] != steps[held][:, :-1])).any(axis=(1, 2))
        bad |= (steps[name][np.arange(len(rows)), last] != g[name][rows]).any(axis=1) if name in g else False
    riders = shard.hand.riders(shard.joint_names)  # (K, L)
    for o in range(index.shape[1] - 1):
        later = free[:, o + 1 :].any(axis=1)  # (n, K)
        carried = later.astype(int) @ riders.astype(int) > 0  # (n, L)
        bad |= (np.take_along_axis(carried, np.maximum(link_of[:, o], 0), 1) & used[:, o]).any(axis=1)
    return bad


def check_parents(shard: JudgedShard, rows: np.ndarray) -> np.ndarray:
    """Rows (n,) of several objects that do not extend an earlier row of one object less bit by bit."""
    g, steps = shard.grasps, shard.steps
    count, parent = (np.asarray(g["object_index"]) >= 0).sum(axis=1), np.asarray(steps["parent"], int)
    names = ("object_index", "object_pose", "contact_points", "contact_normals", "contact_links", "contact_forces")
    columns = [g[k] for k in names if k in g]
    columns += [steps[k] for k in ("space", "free_joints", "q", "q_pregrasp", "q_squeeze")]
    bad = np.zeros(len(rows), bool)
    for i, r in enumerate(rows):
        p, n = parent[r], count[r] - 1
        good = p == -1 if n == 0 else 0 <= p < r and count[p] == n
        if good and n > 0:
            good = all(v[r, :n].tobytes() == v[p, :n].tobytes() for v in columns)
        bad[i] = not (good and len(np.unique(steps["space"][r, : n + 1])) == n + 1)
    return bad

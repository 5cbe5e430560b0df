"""Near-duplicates and distinct object poses of a whole dataset."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from lgrasp.judge.bounds import DUPLICATE_Q, DUPLICATE_R, DUPLICATE_T
from lgrasp.judge.shard import JudgedShard, in_range

SAME_POSE = 1e-6


class Repeats(NamedTuple):
    """Rows of a dataset that an earlier row of the same hand and objects comes close to."""

    near: int
    """Within the distances of near-duplicates."""
    distinct_poses: int
    """Rows whose object poses differ from all earlier ones by more than 1e-6."""


def _neighbours(keys: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Index arrays of pairs j < i within 1 in every coordinate."""
    tree = cKDTree(keys)
    for start in range(0, len(keys), 1000):
        rows = np.arange(start, min(start + 1000, len(keys)))
        lists = tree.query_ball_point(keys[rows], 1.0, p=np.inf)
        i = np.repeat(rows, [len(x) for x in lists])
        j = np.concatenate([np.asarray(x, int) for x in lists])
        yield i[j < i], j[j < i]


def near_duplicates(poses: np.ndarray, q: np.ndarray, joint_scale: np.ndarray) -> np.ndarray:
    """Rows (n,) bool with an earlier row within all distances of near-duplicates.

    Args:
        poses: object poses, shape [n, O, 7], NaN where absent (the same objects in every row).
        q: joint values, shape [n, K].
        joint_scale: difference that counts as 1, shape [K].
    """
    poses = poses[:, ~np.isnan(poses[0, :, 0])]
    t, r, s = poses[..., :3] / DUPLICATE_T, poses[..., 3:], q / joint_scale
    r = r / np.linalg.norm(r, axis=-1, keepdims=True)
    spread = np.argsort(-s.std(axis=0))[:5]
    found = np.zeros(len(q), bool)
    for i, j in _neighbours(np.hstack([t[:, 0], s[:, spread]])):
        dt = np.linalg.norm(t[i] - t[j], axis=-1).max(axis=1)
        cosine = np.abs(np.einsum("nok,nok->no", r[i], r[j])).clip(max=1.0)
        dr = (2.0 * np.arccos(cosine)).max(axis=1) / DUPLICATE_R
        dq = np.abs(s[i] - s[j]).max(axis=1)
        found[i[np.maximum(np.maximum(dt, dr), dq) <= 1.0]] = True
    return found


def distinct_poses(poses: np.ndarray) -> int:
    """Rows (n, D) that differ from all earlier rows by more than 1e-6."""
    unique = np.unique(np.nan_to_num(poses, nan=1e3), axis=0)
    pairs = cKDTree(unique).query_pairs(SAME_POSE, output_type="ndarray")
    return len(unique) - len(np.unique(pairs[:, 1])) if len(pairs) else len(unique)


def count_repeats(shards: Sequence[JudgedShard]) -> Repeats:
    """Repeats over all rows with finite numbers, within each hand and set of objects."""
    groups: dict[Any, list[tuple[np.ndarray, np.ndarray]]] = {}
    scales: dict[Any, np.ndarray] = {}
    for s in shards:
        q, pose, index = (np.asarray(s.grasps[k]) for k in ("q", "object_pose", "object_index"))
        good = in_range(q).all(axis=1) & (index < len(s.objects)).all(axis=1) & (index >= 0).any(axis=1)
        turned = np.linalg.norm(pose[..., 3:].astype(float), axis=-1) > 0.0
        good &= ((index < 0) | (in_range(pose).all(axis=-1) & turned)).all(axis=1)
        pose = np.where((index >= 0)[..., None], pose, np.nan).astype(float)
        for combo in np.unique(index[good], axis=0):
            m = good & (index == combo).all(axis=1)
            key = (s.hand_key, tuple(s.joint_names), tuple(s.object_keys[k] if k >= 0 else "" for k in combo))
            groups.setdefault(key, []).append((pose[m], q[m].astype(float)))
            kinds = [s.hand.movable[n].kind for n in s.joint_names]
            scales[key] = np.array([DUPLICATE_T if kind == "prismatic" else DUPLICATE_Q for kind in kinds])
    found = np.zeros(2, int)
    for key, members in groups.items():
        pose, q = (np.concatenate(x) for x in zip(*members, strict=True))
        sign = np.where(pose[..., 3:4] < 0, -1.0, 1.0)
        flat = np.concatenate([pose[..., :3], sign * pose[..., 3:]], axis=-1).reshape(len(pose), -1)
        found += [near_duplicates(pose, q, scales[key]).sum(), distinct_poses(flat)]
    return Repeats(*found.tolist())

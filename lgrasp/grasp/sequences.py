"""Sequences of grasps: a table that grows by one object a step, as NumPy arrays."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np

from lgrasp.grasp.tables import CONTACTS, GraspTable
from lgrasp.hand.tree import Tree

_LEAST = ("epsilon", "force_closure", "pregrasp_opening", "squeeze_travel", "squeeze_force", "stable_squeeze")
"""Metrics of which the smallest of several steps is that of the row; of others but ``room`` it is the largest."""


@dataclass(frozen=True)
class SequenceTable:
    """N sequences of n steps; step s grasps object s with one opposition space. C contacts per step (palm last)."""

    parent: np.ndarray  # (N,) i64 row of the table before this step that each continues
    candidate: np.ndarray  # (N,) i64 candidate of the last step in its round
    space: np.ndarray  # (N, n) i32 opposition space of each step
    free: np.ndarray  # (N, n, K) bool joints that each step moved
    q: np.ndarray  # (N, n, K) f32
    q_pregrasp: np.ndarray  # (N, n, K)
    q_squeeze: np.ndarray  # (N, n, K)
    pose: np.ndarray  # (N, n, 7) f32 T_hand_object of the internal frames, device poses
    contact_points: np.ndarray  # (N, n, C, 3) objects' internal frames, NaN padding
    contact_normals: np.ndarray  # (N, n, C, 3)
    contact_links: np.ndarray  # (N, n, C) i32, -1 padding
    contact_forces: np.ndarray  # (N, n, C, 3)
    metrics: dict[str, np.ndarray]  # (N,) each: the worst of the steps; room: of the last
    physics: dict[str, np.ndarray] = field(default_factory=dict)  # (N, ...) each: verdicts of a simulator

    def __len__(self) -> int:
        return len(self.parent)

    @property
    def steps(self) -> int:
        """Objects that every row holds."""
        return self.space.shape[1]

    @property
    def used(self) -> np.ndarray:
        """Joints that hold an object, (N, K) bool."""
        return np.asarray(self.free.any(1))

    def posture(self, tree: Tree) -> np.ndarray:
        """Joint positions now, (N, K) f32: those of the last step, or the open posture."""
        if self.steps:
            return self.q[:, -1]
        return np.broadcast_to(tree.joint_open.astype(np.float32), (len(self), len(tree.joint_open)))


class HeldHands(NamedTuple):
    """H hands that hold the same n objects."""

    q: np.ndarray
    """Joints now [rad or m], (H, K)."""
    used: np.ndarray
    """Joints that hold something, (H, K) bool."""
    pose: np.ndarray
    """T_hand_object of the objects' internal frames, device poses (H, n, 7)."""


def empty_sequences(rows: int, joints: int, contacts: int) -> SequenceTable:
    """Rows that hold nothing yet.

    Args:
        rows: N. joints: K. contacts: C.
    """

    def none(*shape: int, dtype: type = np.float32) -> np.ndarray:
        return np.zeros((rows, 0, *shape), dtype)

    return SequenceTable(
        parent=np.full(rows, -1, np.int64),
        candidate=np.arange(rows),
        space=none(dtype=np.int32),
        free=none(joints, dtype=bool),
        q=none(joints),
        q_pregrasp=none(joints),
        q_squeeze=none(joints),
        pose=none(7),
        contact_points=none(contacts, 3),
        contact_normals=none(contacts, 3),
        contact_links=none(contacts, dtype=np.int32),
        contact_forces=none(contacts, 3),
        metrics={},
    )


def extend(
    before: SequenceTable, posture: np.ndarray, row: np.ndarray, space: np.ndarray, free: np.ndarray, grasps: GraspTable
) -> SequenceTable:
    """Sequences that are one step longer: joints that the step may not move stay exactly as they were.

    Args:
        posture: their :meth:`SequenceTable.posture`, (N, K).
        row: row of ``before`` of each grasp, (M,).
        space: opposition space of the step, (M,).
        free: joints that the step may move, (M, K) bool.
        grasps: M grasps of the next object.
    """
    last = posture[row]
    pressing = before.q_squeeze[row, -1] if before.steps else last
    step = {
        "space": space.astype(np.int32),
        "free": free,
        "q": np.where(free, grasps.q, last),
        "q_pregrasp": np.where(free, grasps.q_pregrasp, last),
        "q_squeeze": np.where(free, grasps.q_squeeze, pressing),
        "pose": grasps.pose,
        **{name: getattr(grasps, name) for name in CONTACTS},
    }
    longer: dict[str, Any] = {
        n: np.concatenate([getattr(before, n)[row], values[:, None]], 1) for n, values in step.items()
    }
    metrics = dict(grasps.metrics)
    for name, values in before.metrics.items():
        if name == "room":  # of the fingers that are free now
            continue
        worst = np.fmin if name in _LEAST else np.fmax
        metrics[name] = worst(values[row], metrics[name])
    return SequenceTable(parent=row.astype(np.int64), candidate=grasps.index, metrics=metrics, **longer)

"""Conditions on rows of sequences: each step by itself, and against the row that it extends."""

from collections.abc import Callable

import numpy as np

from lgrasp.grasp.records import GraspRows, SequenceRows
from lgrasp.grasp.schema import CHUNK_ROWS

Column = Callable[[str, int, int], np.ndarray]
"""Rows of the whole file by flat name, first row and the row after the last, as :meth:`ShardReader.column`."""

_Require = Callable[[np.ndarray, str], None]

_INHERITED = (
    "object_index",
    "object_pose",
    "contact_points",
    "contact_normals",
    "contact_links",
    "contact_forces",
    "sequence/space",
    "sequence/free_joints",
    "sequence/q",
    "sequence/q_pregrasp",
    "sequence/q_squeeze",
)

_HELD = {"q": "q", "q_pregrasp": "q", "q_squeeze": "q_squeeze"}
"""Where joints that a step does not move are: in which control pose of the step before."""


def check_steps(rows: GraspRows, steps: SequenceRows, lower: np.ndarray, upper: np.ndarray, require: _Require) -> None:
    """Check a row by itself.

    Args:
        rows: Some rows.
        steps: Their steps.
        lower: Least joint positions [rad or m], shape [K].
        upper: Largest ones, shape [K].
        require: Called with what is good, shape [n, ...], and the text of the problem if some is not.
    """
    present = rows.object_index >= 0  # (n, o)
    space, free = steps.space, steps.free_joints
    require(present[:, :-1] | ~present[:, 1:], "object_index: in a sequence, absent objects must be the last")
    require((space >= 0) == present, "sequence/space: -1 if and only if the object is absent")
    require(
        (space >= -1) & (space < len(steps.space_names)), f"sequence/space: must be -1 to {len(steps.space_names) - 1}"
    )
    if len(set(steps.space_names)) != len(steps.space_names):
        require(np.zeros(len(rows), bool), "sequence/space_names: names repeat")
    order = np.sort(space, axis=1)
    require((order[:, 1:] != order[:, :-1]) | (order[:, 1:] < 0), "sequence/space: a space is used twice")
    require(free.any(2) == present, "sequence/free_joints: a step must move a joint, and an absent one none")
    require(free.sum(1) <= 1, "sequence/free_joints: two steps move one joint")
    frozen = present[:, 1:, None] & ~free[:, 1:]  # (n, o - 1, k)
    for name, held in _HELD.items():
        values = getattr(steps, name)  # (n, o, k)
        good = np.where(present[..., None], np.isfinite(values), np.isnan(values))
        require(good, f"sequence/{name}: NaN if and only if the object is absent")
        last = np.maximum(present.sum(1) - 1, 0)
        require(getattr(rows, name) == values[np.arange(len(last)), last], f"{name}: not that of the last step")
        kept = ~frozen | (values[:, 1:] == getattr(steps, held)[:, :-1])
        require(kept, f"sequence/{name}: a joint that the step does not move is not at {held} of the step before")
    require(~((steps.q < lower) | (steps.q > upper)), "sequence/q: outside the joint limits by more than 1e-4")


def check_parents(rows: GraspRows, steps: SequenceRows, column: Column, first_row: int, require: _Require) -> None:
    """Check rows against the rows that they extend, and against the order of rows.

    Args:
        rows: Some rows.
        steps: Their steps.
        column: The whole file.
        first_row: Index of ``rows[0]`` in it.
        require: As of :func:`check_steps`.
    """
    count = (rows.object_index >= 0).sum(1)
    before = (column("object_index", max(first_row - 1, 0), first_row) >= 0).sum(1)
    order = np.concatenate([before if first_row else count[:1], count])
    require(order[1:] >= order[:-1], "object_index: in sequences, rows of fewer objects must come first")
    number = first_row + np.arange(len(count))
    parent = steps.parent
    require((parent >= 0) == (count > 1), "sequence/parent: -1 if and only if the row has one object")
    require((parent >= -1) & (parent < number), "sequence/parent: must be an earlier row")
    known = (parent >= 0) & (parent < number)
    inherited = np.ones((len(_INHERITED), len(count)), bool)
    shorter = np.ones(len(count), bool)
    mine = rows.columns()
    for block in np.unique(parent[known] // CHUNK_ROWS):
        start = int(block) * CHUNK_ROWS
        some = np.flatnonzero(known & (parent // CHUNK_ROWS == block))
        at = parent[some] - start
        for place, name in enumerate(_INHERITED):
            theirs = column(name, start, start + CHUNK_ROWS)[at]
            if name == "object_index":
                shorter[some] = (theirs >= 0).sum(1) == count[some] - 1
            inherited[place, some] = _same_steps(mine[name][some], theirs, count[some] - 1)
    require(shorter, "sequence/parent: must have one object less")
    for name, good in zip(_INHERITED, inherited, strict=True):
        require(good, f"{name}: earlier steps differ from those of the parent")


def _same_steps(a: np.ndarray, b: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Which rows agree in their first ``steps`` [n] slots, NaN with NaN; both are [n, O, ...]."""
    same = (a == b) | ((a != a) & (b != b))
    beyond = np.arange(a.shape[1]) >= steps[:, None]  # (n, o)
    return (same.reshape(*a.shape[:2], -1).all(2) | beyond).all(1)

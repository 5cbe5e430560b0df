"""Rows of several objects -> groups of the same objects, each group with as many slots as it has objects."""

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from lgrasp.errors import PhysicsError
from lgrasp.grasp.records import GraspRows

_BY_SLOT = ("object_pose", "object_index", "contact_points", "contact_normals", "contact_links", "contact_forces")


class Group(NamedTuple):
    """Rows that have the same objects, whatever their slots."""

    objects: tuple[int, ...]
    """Positions in the scene's objects, ascending."""
    index: np.ndarray
    """(n,) rows of the table."""
    slots: np.ndarray
    """(n, O) which of ``objects`` is in each slot of the table, -1 absent."""
    rows: GraspRows
    """The rows with the objects in that order, and no others."""


def group_rows(rows: GraspRows, objects: int) -> Iterator[Group]:
    """Groups in the order of their objects.

    Args:
        objects: of the scene.

    Raises:
        PhysicsError: a row has no object, or one that the scene lacks.
    """
    index = np.asarray(rows.object_index)
    present = (index >= 0).sum(1)
    wrong = np.flatnonzero((present == 0) | (index.max(1, initial=-1) >= objects))
    if len(wrong):
        raise PhysicsError(
            f"row {wrong[0]} has object_index {index[wrong[0]].tolist()}; one object at least, of {objects} that "
            f"there are, is needed"
        )
    absent_last = np.where(index >= 0, index, objects)
    order = np.argsort(absent_last, axis=1, kind="stable")  # (N, O) slots by their objects
    sorted_index = np.take_along_axis(absent_last, order, 1)
    rank = np.where(index >= 0, np.argsort(order, axis=1), -1)
    sets, which = np.unique(sorted_index, axis=0, return_inverse=True)
    for number, members in enumerate(sets):
        found = np.flatnonzero(which.ravel() == number)
        taken = tuple(int(k) for k in members if k < objects)
        slots = order[found, : len(taken)]
        arrays = {name: getattr(rows, name)[found[:, None], slots] for name in _BY_SLOT}
        arrays |= {name: getattr(rows, name)[found] for name in ("q", "q_pregrasp", "q_squeeze", "candidate")}
        bare = replace(rows, **arrays, metrics={}, metric_units={}, physics={}, physics_protocols={}, sequence=None)
        yield Group(taken, found, rank[found], bare)

"""Contact sets that do not become grasps, finished and measured all the same: negatives for those who learn."""

from dataclasses import replace

import numpy as np

from lgrasp.geometry.poses import device_matrix
from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.check import check_grasps, known_contacts
from lgrasp.grasp.outcomes import failed_bounds
from lgrasp.grasp.rows import press
from lgrasp.grasp.tables import ContactSets, GraspTable, take_rows, trim_sets
from lgrasp.runtime.fetch import fetch
from lgrasp.stages.context import Context
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.filter.stage import placed_hands, placed_postures


def failed_rows(
    inputs: ContactSets, params: FilterParams, context: Context, bounds: GraspBounds, per_pose: int
) -> GraspTable:
    """Rows that fail a bound, of a few sets of each pose, with all numbers measured as they are.

    Fingers without contact that find no place are open. Metric ``failed_bound`` says by code of
    :data:`~lgrasp.grasp.outcomes.FAILED_BOUNDS` which bound is the first that fails.

    Args:
        context: with the bounds that the sets were found within.
        bounds: that rows fail.
        per_pose: sets that are tried at each pose, the first that were found.
    """
    some = _few(trim_sets(inputs), per_pose)
    check = placed_hands(some, params, context, opened=True)
    at, places, obj = check.at, check.places, context.object
    pose, q = placed_postures(check)
    of, contact, surface, slot, pose, q = fetch([at.of, at.contact, at.surface, at.slot, pose, q])
    link, point, normal, index, resting = fetch([places.link, places.points, places.normals, at.index, at.resting])
    links, place = np.where(contact >= 0, link[contact], -1), np.maximum(surface, 0)
    contacts = known_contacts(links.astype(np.int32), point[place], normal[place], context.device)
    table, outcome = check_grasps(
        *(context.hand, obj, pose, q, contacts, bounds),
        resting=resting[of] if obj.planes is not None else None,
        index=index[of],
        seed=context.seed("filter", 1),
    )
    table = replace(press(table), slot=slot)
    table.metrics["failed_bound"] = failed_bounds(table, outcome, bounds, context.hand.model.tree.link_groups)
    if obj.planes is not None:
        table.table["approach"] = _from_above(table, obj.planes)
    return take_rows(table, table.metrics["failed_bound"] > 0)


def _few(sets: ContactSets, per_pose: int) -> ContactSets:
    """The first sets of each pose; they come pose by pose."""
    (pose,) = fetch([sets.pose])
    first = np.searchsorted(pose, pose)  # of the same pose
    return replace(sets, **sets.taken(np.flatnonzero(np.arange(len(pose)) - first < per_pose)))


def _from_above(table: GraspTable, planes: np.ndarray) -> np.ndarray:
    """Directions of approach, (n, 3); straight to the table where the hand has no way."""
    way = table.table["approach"]
    up = planes[table.table["pose"], :3]
    down = -np.einsum("nij,nj->ni", device_matrix(table.pose)[:, :3, :3], up)
    return np.where(np.isnan(way[:, :1]), down, way).astype(np.float32)

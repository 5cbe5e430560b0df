"""refine: finished grasps -> the same, moved by a local search wherever that makes them better."""

import numpy as np

from lgrasp.geometry.poses import device_inverse
from lgrasp.grasp.check import check_grasps
from lgrasp.grasp.find_contacts import contact_width, find_contacts
from lgrasp.grasp.tables import GraspTable, grasp_arrays, grasps_from_arrays
from lgrasp.refine.descent import Descent
from lgrasp.refine.hands import Hands
from lgrasp.refine.params import LocalSearch
from lgrasp.refine.surface import hand_surface
from lgrasp.refine.volume import upload_target
from lgrasp.stages.context import Context
from lgrasp.stages.refine.params import RefineParams

VERSION = 3


def run(inputs: GraspTable, params: RefineParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Refine grasps; a refined grasp takes its row's place where it passes every check and resists pulls better.

    Every check is made anew on the refined posture, by the measures of filter. Rows stay where they are: none is lost.

    Returns:
        The grasps in the order given; how many there were, passed the checks once refined, and were replaced.
    """
    width = max(inputs.contact_links.shape[1], contact_width(context.hand.model.contact_link))
    if len(inputs) == 0:
        return _widened(inputs, width), {"tried": 0, "passed": 0, "replaced": 0}
    tree = context.hand.model.tree
    at = Hands.put(device_inverse(inputs.pose), np.clip(inputs.q, tree.joint_lower, tree.joint_upper), context.device)
    _descent(params, context).run(at)
    pose, q = at.numpy()
    pose, bounds = device_inverse(pose), context.bounds
    contacts = find_contacts(context.hand, context.object, pose, q, bounds)
    table, outcome = check_grasps(context.hand, context.object, pose, q, contacts, bounds, index=inputs.index)
    passed = outcome == 0
    better = passed & (table.metrics["unresisted_load"] < inputs.metrics["unresisted_load"])
    counts = {"tried": len(inputs), "passed": int(passed.sum()), "replaced": int(better.sum())}
    return _replaced(_widened(inputs, width), _widened(table, width), better), counts


def _descent(search: LocalSearch, context: Context) -> Descent:
    """The local search of a job: made by the first batch, used by all."""
    key = (context.hand.model.sha256, context.object.model.sha256, context.object.model.scale, search, context.device)

    def make() -> Descent:
        target = upload_target(context.object.model, None, context.device)
        return Descent(context.hand, target, search, hand_surface(context.hand.model))

    return context.kept.get("refine", key, make)


def _replaced(old: GraspTable, new: GraspTable, rows: np.ndarray) -> GraspTable:
    """``old`` with some rows (N,) bool of ``new``; slots stay."""
    a, b = grasp_arrays(old), grasp_arrays(new)
    b["slot"] = a["slot"]
    return grasps_from_arrays({name: np.where(_over(rows, x), b[name], x).astype(x.dtype) for name, x in a.items()})


def _over(rows: np.ndarray, x: np.ndarray) -> np.ndarray:
    return rows.reshape(-1, *(1,) * (x.ndim - 1))


def _widened(table: GraspTable, width: int) -> GraspTable:
    """The table with room for ``width`` contacts at least."""
    missing = width - table.contact_links.shape[1]
    if missing <= 0:
        return table
    out = grasp_arrays(table)
    for name in ("contact_points", "contact_normals", "contact_links", "contact_forces"):
        x = out[name]
        none = -1 if name == "contact_links" else np.nan
        out[name] = np.pad(x, [(0, 0), (0, missing)] + [(0, 0)] * (x.ndim - 2), constant_values=none)
    return grasps_from_arrays(out)

"""refine: finished grasps -> the same, moved by a local search wherever that makes them better."""

from functools import partial

import numpy as np

from lgrasp.grasp.find_contacts import check_found, contact_width
from lgrasp.grasp.outcomes import Outcome
from lgrasp.grasp.tables import GraspTable, choose_grasps, widen_grasps
from lgrasp.refine.descent import Descent
from lgrasp.refine.improve import improve
from lgrasp.refine.params import LocalSearch
from lgrasp.refine.surface import hand_surface
from lgrasp.refine.volume import upload_target
from lgrasp.stages.context import Context
from lgrasp.stages.refine.params import RefineParams
from lgrasp.steer.demands import Demands

VERSION = 10


def run(inputs: GraspTable, params: RefineParams, context: Context) -> tuple[GraspTable, dict[str, int]]:
    """Refine grasps; a refined grasp takes its row's place where it passes every check and resists pulls better.

    Every check is repeated on the refined posture, by the measures of filter. Rows stay where they are: none is lost.

    Returns:
        The grasps in the order given; how many there were, passed the checks once refined, and were replaced.
    """
    width = max(inputs.contact_links.shape[1], contact_width(context.hand.model.contact_link))
    if len(inputs) == 0:
        return widen_grasps(inputs, width), {"tried": 0, "passed": 0, "replaced": 0}
    tree, hand, obj = context.hand.model.tree, context.hand, context.object
    q = np.clip(inputs.q, tree.joint_lower, tree.joint_upper)
    once = np.ones(len(inputs), int)  # rows that came are valid: there is nothing to begin again for
    told = context.steer.told if context.steer else {}
    check = Demands.read(told, hand.model, "steer").check if told else check_found
    table, outcome = improve(
        _descent(params, context),
        hand,
        partial(check, hand, obj, bounds=context.bounds),
        inputs.pose,
        q,
        tries=once,
        index=inputs.index,
    )
    passed = outcome == Outcome.KEPT
    better = np.flatnonzero(passed & (table.metrics["unresisted_load"] < inputs.metrics["unresisted_load"]))
    counts = {"tried": len(inputs), "passed": int(passed.sum()), "replaced": len(better)}
    made = choose_grasps(widen_grasps(inputs, width), widen_grasps(table, width), better, better)
    return made, counts


def _descent(search: LocalSearch, context: Context) -> Descent:
    """The local search of a job: made by the first batch, used by all."""

    def make() -> Descent:
        target = upload_target(context.object.model, None, context.device)
        return Descent(context.hand, target, search, hand_surface(context.hand.model))

    return context.once("refine", make, search)

"""filter: contact sets with joint positions -> finished grasps, every claim recomputed."""

import numpy as np
import warp as wp

from lgrasp.grasp.check import Check
from lgrasp.grasp.check_kernels import OTHERS, TOUCHING
from lgrasp.grasp.check_structs import CheckedPostures, Places, device_limits, new_findings
from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.find_contacts import contact_width, palmar_runs, touching_links
from lgrasp.grasp.tables import ContactSets, GraspTable, trim_sets
from lgrasp.hand.contact_surface import contact_surface
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import Tally
from lgrasp.stages.context import Context
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.filter.posture_kernels import (
    SetCandidates,
    fill_unused,
    open_hands,
    place_touching,
    take_contacts,
    tell_postures,
)

VERSION = 23


def run(inputs: ContactSets, params: FilterParams, context: Context) -> tuple[GraspTable, Tally]:
    """Fill unused fingers, check everything exactly on the final q, add control poses and metrics.

    The one stage that waits for its number of rows: its tables are wide, and much fewer sets than there could be come.

    Returns:
        The grasps in (candidate, slot) order, and the number of sets per outcome
        (:data:`~lgrasp.grasp.outcomes.REASONS`).
    """
    check = placed_hands(trim_sets(inputs), params, context)
    check.clear_table(OTHERS)
    check.measure(OTHERS)
    if context.opposed:
        check.measure_held()
    if params.contacts == "all":
        _take_all(check, context)
    return check.kept(context.seed("filter", 1))


def placed_hands(inputs: ContactSets, params: FilterParams, context: Context, *, opened: bool = False) -> Check:
    """The hands of sets (:func:`trim_sets`): touching fingers, then the others, checked as far as that took.

    Args:
        opened: fingers that find no place are open; else those of hands that failed are anywhere.
    """
    d, n = context.device, inputs.pose.shape[0]
    hand, field, obj = context.hand.struct, context.field.struct, context.object.struct
    limits, held = device_limits(context.bounds), context.held.struct
    width = context.hand.model.groups + 1
    if params.contacts == "all":
        width = max(width, contact_width(context.hand.model.contact_link))
    at = _postures(inputs, width, context)
    sets = make_struct(SetCandidates, inputs.candidates.poses, inputs.candidates)
    places = make_struct(Places, hand.contacts, points=obj.contact_points, normals=obj.contact_normals)
    found = new_findings(n, at.contact.shape[1], d)
    check = Check(context.hand, context.object, context.held, limits, places, at, found)
    if opened:
        wp.launch(open_hands, n, [hand, sets], [at], device=d)
    least = 0 if params.contacts == "all" else context.bounds.min_contacts  # those of other links join later
    wp.launch(place_touching, n, [hand, field, held, limits, places, sets, least], [at, found], device=d)
    check.clear_table(TOUCHING)
    check.measure(TOUCHING)
    seed = context.seed("filter")
    wp.launch(fill_unused, n, [hand, field, obj, held, limits, seed, params.draws, sets], [at, found], device=d)
    return check


def placed_postures(check: Check) -> tuple[wp.array, wp.array]:
    """T_hand_object (n,) and joint positions (n, K) [rad or m] of hands."""
    d, n, hand = check.hand.device, len(check), check.hand
    pose, q = wp.empty(n, dtype=wp.transform, device=d), wp.empty((n, hand.model.dofs), dtype=float, device=d)
    wp.launch(tell_postures, n, [hand.struct, check.at], [pose, q], device=d)
    return pose, q


def _take_all(check: Check, context: Context) -> None:
    """Contacts of further links that touch join those that search combined."""
    d, n, hand = context.device, len(check), context.hand.struct
    pose, q = placed_postures(check)
    runs = allowed_runs(context)
    found = touching_links(context.hand, context.object, check.limits, runs, pose, q)
    inputs = [hand, check.limits, check.places, runs, *found]
    wp.launch(take_contacts, n, inputs, [check.at, check.found], device=d)


def _postures(inputs: ContactSets, width: int, context: Context) -> CheckedPostures:
    d, n, model, poses = context.device, inputs.pose.shape[0], context.hand.model, inputs.candidates.poses
    contact, surface = (wp.empty((n, width), dtype=wp.int32, device=d) for _ in range(2))
    body = wp.empty((n, len(model.piece_first) - 2), dtype=wp.transform, device=d)
    given = {
        "pose": poses.pose,
        "index": poses.index,
        "resting": poses.resting,
        "of": inputs.pose,
        "slot": inputs.slot,
        "chosen": inputs.chosen,
    }
    return empty_struct(CheckedPostures, d, n, model.groups, body=body, contact=contact, surface=surface, **given)


def allowed_runs(context: Context) -> PalmarRuns:
    """The contact surface of the hand as far as a steering lets it touch; made once for a job."""

    def make() -> PalmarRuns:
        at = np.flatnonzero(context.steered.touching.points)
        return palmar_runs(context.hand, contact_surface(context.hand.model), at)

    return context.once("allowed", make, context.steered)

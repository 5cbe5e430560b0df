"""filter: contact sets with joint positions -> finished grasps, every claim recomputed."""

import warp as wp

from lgrasp.grasp.check import Check
from lgrasp.grasp.check_kernels import OTHERS, TOUCHING
from lgrasp.grasp.check_structs import CheckedPostures, Places, device_limits, new_findings
from lgrasp.grasp.tables import ContactSets, GraspTable, trim_sets
from lgrasp.math.kinematics import vec_dof
from lgrasp.runtime.tally import Tally
from lgrasp.stages.context import Context
from lgrasp.stages.filter.params import FilterParams
from lgrasp.stages.filter.posture_kernels import SetCandidates, fill_unused, place_touching

VERSION = 7


def run(inputs: ContactSets, params: FilterParams, context: Context) -> tuple[GraspTable, Tally]:
    """Fill unused fingers, check everything exactly on the final q, add control poses and metrics.

    The one stage that waits for its number of rows: its tables are wide, and much fewer sets than there could be come.

    Returns:
        The grasps in (candidate, slot) order, and the number of sets per outcome
        (:data:`~lgrasp.grasp.outcomes.REASONS`).
    """
    inputs = trim_sets(inputs)
    d, n = context.device, inputs.pose.shape[0]
    hand, field, obj = context.hand.struct, context.field.struct, context.object.struct
    limits, held = device_limits(context.bounds), context.held.struct
    sets, at, places = _sets(inputs), _postures(inputs, context), _places(context)
    found = new_findings(n, at.contact.shape[1], d)
    check = Check(context.hand, context.object, context.held, limits, places, at, found)
    wp.launch(place_touching, n, [hand, field, held, limits, places, sets], [at, found], device=d)
    check.measure(TOUCHING)
    seed = context.seed("filter")
    wp.launch(fill_unused, n, [hand, field, obj, held, limits, seed, params.draws, sets], [at, found], device=d)
    check.measure(OTHERS)
    if context.space:
        check.measure_held()
    return check.kept(context.seed("filter", 1))


def _sets(inputs: ContactSets) -> SetCandidates:
    table, poses = inputs.candidates, inputs.candidates.poses
    s = SetCandidates()
    s.palm_point, s.palm_surface, s.setting = poses.palm_point, poses.palm_surface, poses.setting
    s.surface, s.record, s.q = table.surface, table.record, table.q
    return s


def _postures(inputs: ContactSets, context: Context) -> CheckedPostures:
    d, n, model, poses = context.device, inputs.pose.shape[0], context.hand.model, inputs.candidates.poses
    at = CheckedPostures()
    at.pose, at.index, at.of, at.slot, at.chosen = poses.pose, poses.index, inputs.pose, inputs.slot, inputs.chosen
    at.body = wp.empty((n, len(model.piece_first) - 2), dtype=wp.transform, device=d)
    at.posture = wp.empty((n, model.groups), dtype=vec_dof, device=d)
    at.contact, at.surface = (wp.empty((n, model.groups + 1), dtype=wp.int32, device=d) for _ in range(2))
    return at


def _places(context: Context) -> Places:
    contacts, obj = context.hand.struct.contacts, context.object.struct
    places = Places()
    places.link, places.body, places.grid = contacts.link, contacts.body, contacts.grid
    places.points, places.normals = obj.contact_points, obj.contact_normals
    return places

"""search: candidates -> sets of contacts that balance."""

import math
from typing import Any

import numpy as np
import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.grasp.check_structs import device_limits
from lgrasp.grasp.collision import depth_slices
from lgrasp.grasp.structs import State
from lgrasp.grasp.tables import CandidateTable, ContactSets
from lgrasp.math.constants import LOAD_DIRECTIONS
from lgrasp.math.limits import MAX_GROUPS, MAX_KINDS
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.search.finger_kernels import (
    UNKNOWN,
    check_fit,
    drop_unfit,
    find_clashes,
    find_stuck,
    find_sunk,
    list_candidates,
    list_fingers,
)
from lgrasp.stages.search.kernels import (
    SearchCount,
    check_balance,
    check_fingers,
    check_load,
    give_up,
    keep_sets,
    leave_poor,
    list_hits,
    list_usable,
    take_sets,
)
from lgrasp.stages.search.mutate_kernels import mutate_contacts
from lgrasp.stages.search.params import SearchParams
from lgrasp.stages.search.sets import AskedCandidates, FoundSets, Hits, SearchValues, TriedSets, Usable, vec_kinds
from lgrasp.stages.search.swap_kernels import swap_contacts

VERSION = 15

_CPU_STARTS = 2  # of a pose in one launch
_GPU_STARTS = 10  # and on every device where what is left out of later starts depends on it
_MOST_STARTS = 40  # there: as many as came before, so that many starts take few launches
_MOST_PAIRED = 32  # candidates of a finger, bits of a word
_THREADS = 1 << 18  # most of a check, however few sets are left


def run(inputs: CandidateTable, params: SearchParams, context: Context) -> tuple[ContactSets, Tally]:
    """Block-wise zeroth-order search at every pose (Alg. 2).

    Combines realised contacts only, and keeps fingers apart, where ik came before (``context.realised``); else
    candidates as drawn.

    Returns:
        Sets in (pose, slot) order, and counts ``poses``, ``yielding`` (poses with a set), ``sets``.
    """
    d = context.device
    n, groups, keep = inputs.surface.shape
    if groups > MAX_GROUPS:
        raise ConfigError(f"search: {groups} fingers; at most {MAX_GROUPS} are supported")
    number = wp.zeros(n, dtype=wp.int32, device=d)
    found = empty_struct(FoundSets, d, n, params.per_pose, groups, number=number)
    swap = params.method == "swap"
    exact = swap and (params.check_depth or params.check_opening) and context.realised
    shape = (n, groups, keep) if exact else (0, 0, 0)
    given: dict[str, Any] = {"unfit": wp.full(shape, int(UNKNOWN), dtype=wp.int32, device=d)}
    pairs = exact and params.check_pairs and keep <= _MOST_PAIRED
    given["clash"] = wp.zeros((*shape, groups) if pairs else (0, 0, 0, 0), dtype=wp.uint32, device=d)
    given |= {"point": wp.empty((0, 0, 0), dtype=wp.vec3, device=d)} if swap else {}
    given["most"] = wp.empty(n if inputs.further.shape[2] else 0, dtype=wp.int32, device=d)
    given["ranked"] = int(inputs.further.shape[2] > 0)
    usable = empty_struct(Usable, d, n, groups, keep, **given)
    obj, values = context.object.struct, _values(params, context)
    state = State.REALISED if context.realised else State.DRAWN
    wp.launch(list_usable, (n, groups), [obj, int(state), inputs.struct], [usable], device=d)
    if usable.ranked:
        wp.launch(leave_poor, n, [values, inputs.struct], [usable], device=d)
    if pairs:
        _find_clashes(usable, inputs, context)
    kernel = (swap_contacts if swap else mutate_contacts)[params.score]
    # starts in rounds: poses that have their sets stop early, and a GPU still has enough threads
    paced = exact or (swap and _bounds_load(values))
    few = _CPU_STARTS if d == "cpu" and not paced else _GPU_STARTS
    starts = params.restarts
    if swap:  # no more than there are sets
        sizes = {min(k, groups) for k in params.contacts}  # where the palm stands in for a finger
        starts = min(starts, sum(math.comb(groups, k) * keep**k for k in sizes))
    lanes = min(starts, few if params.per_pose < starts else starts)
    room = empty_struct(TriedSets, d, n, min(starts, max(lanes, _MOST_STARTS)) if paced else lanes, groups)
    first = 0
    while n and first < starts:
        lanes = min(max(lanes, min(first // 2, _MOST_STARTS if paced else 0)), starts - first)
        tried = make_struct(TriedSets, room, score=room.score[:, :lanes])
        values.per_pose = params.per_pose - (params.taper * params.per_pose * first) // params.restarts
        # none at first, so that poses are given up by sets of any
        values.more = params.extra_contacts if usable.ranked and first else 0
        asked = [obj, values, context.seed("search", context.salt), first, inputs.struct, usable, found]
        wp.launch(kernel, tried.score.shape, asked, [tried], device=d)
        if swap:
            _check_sets(tried, usable, values, inputs, context, params, early=first == 0)
        wp.launch(keep_sets, n, [values, inputs.struct, tried], [found], device=d)
        first += lanes
    upto = wp.clone(found.number)
    running_sums(upto)
    table = ContactSets.empty(d, n * params.per_pose, groups, candidates=inputs)
    tally = empty_tally(SearchCount, d)
    asked = [upto, inputs.struct, context.salt * params.per_pose, found]
    wp.launch(take_sets, n, asked, [table.struct, tally.device], device=d)
    return table, tally


def _check_sets(
    tried: TriedSets,
    usable: Usable,
    values: Any,
    inputs: CandidateTable,
    context: Context,
    params: SearchParams,
    *,
    early: bool,
) -> None:
    """Scores of tried sets go below 0 where a set fails; each check comes side by side for those that are left.

    Args:
        early: give up poses of which no set resists the hardest pull.
    """
    d, size = context.device, tried.score.size
    hand, obj = context.hand.struct, context.object.struct
    hits = empty_struct(Hits, d, size, **_no_entries(d))

    def check(kernel: wp.Kernel, dim: tuple[int, ...], asked: list[Any], outputs: list[Any]) -> None:
        hits.number.zero_()
        wp.launch(list_hits, tried.score.shape, [tried], [hits], device=d)
        hits.stride, dim = _shared(size, dim)
        wp.launch(kernel, dim, [hits, *asked], outputs, device=d)

    sets = [obj, values, inputs.struct]
    if _bounds_load(values):
        # most fail in the hardest direction: it comes alone
        for some, directions in ((0, 1), (1, LOAD_DIRECTIONS - 1)):
            check(check_load, (-1, directions), [obj, values, some, inputs.struct], [tried])
            if early and some == 0:
                wp.launch(give_up, usable.size.shape, [tried], [usable], device=d)
    check(check_balance, (-1,), sets, [tried])
    if not context.realised:
        return
    groups = context.hand.model.groups
    if not usable.clash.size:
        check(check_fingers, (groups, groups, -1), [hand, values, inputs.struct], [tried])
    if usable.unfit.size:
        asked = empty_struct(AskedCandidates, d, usable.unfit.size, **_no_entries(d))
        check(list_fingers, (groups, -1), [tried], [usable, asked])
        _check_fingers(asked, usable, inputs, context, params)
        check(check_fit, (-1,), [usable], [tried])
        wp.launch(drop_unfit, usable.size.shape, [], [usable], device=d)
        if usable.ranked:
            wp.launch(leave_poor, usable.size.shape[0], [values, inputs.struct], [usable], device=d)


def _find_clashes(usable: Usable, inputs: CandidateTable, context: Context) -> None:
    """Which usable candidates of two fingers meet."""
    d, size, groups = context.device, usable.unfit.size, context.hand.model.groups
    asked = empty_struct(AskedCandidates, d, size, **_no_entries(d))
    wp.launch(list_candidates, usable.size.shape, [usable], [asked], device=d)
    asked.stride, dim = _shared(size, (groups, -1))
    given = [asked, context.hand.struct, device_limits(context.bounds), inputs.struct]
    wp.launch(find_clashes, dim, given, [usable], device=d)


def _check_fingers(
    asked: AskedCandidates, usable: Usable, inputs: CandidateTable, context: Context, params: SearchParams
) -> None:
    """Which of the candidates that are listed the filter would refuse."""
    d, size, limits = context.device, usable.unfit.size, device_limits(context.bounds)
    hand, obj, table = context.hand.struct, context.object.struct, inputs.struct
    if params.check_depth:
        slices, bodies = depth_slices(d), int(np.diff(context.hand.model.tree.joint_first).max())
        asked.stride, dim = _shared(size, (slices, bodies, -1))
        wp.launch(find_sunk, dim, [asked, hand, obj, limits, table, slices], [usable], device=d)
    if params.check_opening:
        asked.stride, dim = _shared(size, (-1,))
        given = [asked, hand, context.field.struct, obj, context.held.struct, limits, table]
        wp.launch(find_stuck, dim, given, [usable], device=d)


def _no_entries(device: str) -> dict[str, Any]:
    """What an empty list begins with."""
    return {"number": wp.zeros(1, dtype=wp.int32, device=device), "stride": 0}


def _shared(size: int, dim: tuple[int, ...]) -> tuple[int, tuple[int, ...]]:
    """How many threads share at most ``size`` things, of which there may be few, and ``dim`` with these for -1."""
    others = math.prod(n for n in dim if n > 0)
    threads = max(1, min(size, _THREADS // others))
    return threads, tuple(threads if n < 0 else n for n in dim)


def _bounds_load(values: Any) -> bool:
    """Whether grasps must resist pulls at all."""
    return values.max_unresisted_load < 1.0


def _values(params: SearchParams, context: Context) -> Any:
    kinds, model = len(params.contacts), context.object.model
    return make_struct(
        SearchValues,
        params,
        context.bounds,
        contacts=vec_kinds(*params.contacts, *[0] * (MAX_KINDS - kinds)),
        kinds=kinds,
        between=sum(1 << k for k in {*range(min(params.contacts), max(params.contacts))} - {*params.contacts}),
        more=0,
        least=context.steered.least,
        max_gswo=params.gswo_share * context.bounds.max_gswo,
        mutation_sigma=params.mutation_sigma * math.sqrt(model.area / len(model.contact_points)),
    )

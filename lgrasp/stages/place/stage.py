"""place: candidate indices -> object poses in the hand base frame that static links do not block."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.field.arrays import FieldArrays
from lgrasp.geometry.shares import entries_of
from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.scan import running_sums
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import Tally, empty_tally
from lgrasp.stages.context import Context
from lgrasp.stages.place.kernels import choose_poses, propose_poses, take_poses
from lgrasp.stages.place.opposed_kernels import propose_opposed
from lgrasp.stages.place.params import PlaceParams
from lgrasp.stages.place.predicted_kernels import propose_predicted
from lgrasp.stages.place.rating import rated_chance
from lgrasp.stages.place.structs import PlaceCount, PlaceValues, ProposedPoses
from lgrasp.steer.arrays import Steer

VERSION = 11

_FAVOURED_DRAWS = 128  # poses for each point of the palm
_FAVOURED_SEED = 1  # of these: the same in all shards
_FAVOURED_ENTRIES = 4096  # of the list that points are drawn from
_PROPOSALS, _PROPOSALS_ABOVE = 8, 24  # for each candidate, and above a table or plane, which blocks most
_EVERYWHERE = 0.6  # of the mean chance, added to that of each point


def run(inputs: tuple[int | wp.array, int], params: PlaceParams, context: Context) -> tuple[PoseTable, Tally]:
    """Poses of candidates ``first .. first + count - 1`` of the shard's stream.

    In an opposition space all of them are between its two sides, and the weights play no part; where poses are
    predicted (``context.predicted``), those are taken.

    Args:
        inputs: ``first`` (a number, or an array (1,) i32 on the device) and ``count``.

    Returns:
        The poses that can hold, in candidate order, and counts ``tried``, ``blocked`` (by static links), ``kept``.

    Raises:
        ConfigError: all weights are zero.
    """
    first, count = inputs
    rated = context.policy is not None and not context.opposed
    sources = context.networks.sources if rated else {}
    shares = _shares(params, sources, context.field, palm=context.steered.touching.palm)
    d = context.device
    if not isinstance(first, wp.array):
        first = wp.full(1, first, dtype=wp.int32, device=d)
    hand, field, obj = context.hand.struct, context.field.struct, context.object.struct
    if rated:
        tried = params.policy_proposals or context.networks.proposals
    else:
        tried = params.proposals or (_PROPOSALS if context.object.planes is None else _PROPOSALS_ABOVE)
    groups, shape = context.hand.model.groups, (count, tried)
    proposals = empty_struct(ProposedPoses, d, *shape, groups)
    regions = context.object.steered
    # of contacts that must be far from the centre of mass, the line between two is far from it as well
    reach = params.max_com_distance + (regions.off_centre if regions else 0.0)
    values = make_struct(PlaceValues, params, context.bounds, **shares, max_com_distance=reach)
    where = [context.seed("place"), first]
    if not context.opposed:
        steer = context.steered.struct
        if rated and params.samples == 0 and shares["palm"] > 0 and context.steered.poses is None:
            steer = _favoured_palm(values, context)
        kernel, asked = propose_poses, [values, steer, context.networks.reach]
    elif context.predicted is None:
        kernel, asked = propose_opposed, [context.held.struct, values]
    else:
        kernel, asked = propose_predicted, [context.held.struct, context.predicted, values]
    wp.launch(kernel, shape, [hand, field, obj, *asked, *where], [proposals], device=d)
    return best_poses(proposals, values, first, context)


def _shares(params: PlaceParams, learnt: Mapping[str, float], field: FieldArrays, *, palm: bool) -> dict[str, float]:
    """Share of each source in the proposals, by weight and by what it was ``learnt`` to be worth; where the palm must
    touch, of those that put the object on it."""
    weights = params.weights
    if palm:
        on_palm = bool((field.model.pair_slot < 0).any(1).all())  # pairs of a lone finger and the palm
        weights |= {"canonical": 0.0, "exhaustive": 0.0, "palm": params.palm or 1.0}
        weights["pinch"] = params.pinch if on_palm else 0.0
    weights = {name: weight * learnt.get(name, 1.0) for name, weight in weights.items()}
    total = sum(weights.values())
    if total <= 0:
        raise ConfigError("place: weights canonical, exhaustive, pinch and palm are all 0; one must be positive")
    return {name: weights[name] / total for name in ("canonical", "pinch", "palm")}


def _favoured_palm(values: PlaceValues, context: Context) -> Steer:
    """What is asked, with each contact point of the palm as often as the policy's mean chance of poses on it says.

    Made once for a job. For policies that go by distances alone, which rate many poses in no time.
    """

    def make() -> Steer:
        d, steer = context.device, context.steered.struct
        palm = to_numpy(steer.palm_points)
        shape = (len(palm), _FAVOURED_DRAWS)
        proposals = empty_struct(ProposedPoses, d, *shape, context.hand.model.groups)
        on_palm = make_struct(PlaceValues, values, canonical=0.0, pinch=0.0, palm=1.0, policy_temperature=0.0)
        models = [context.hand.struct, context.field.struct, context.object.struct]
        where = [wp.full(1, at, dtype=wp.int32, device=d) for at in (_FAVOURED_SEED, 0)]
        asked = [on_palm, steer, context.networks.reach]
        wp.launch(propose_poses, shape, [*models, *asked, *where], [proposals], device=d)
        chance = rated_chance(to_numpy(proposals.rating)).ravel()
        if not chance.any():
            return steer
        point, ends = to_numpy(proposals.palm_point).ravel(), int(palm.max()) + 1
        mean = np.bincount(point, chance, ends) / np.maximum(np.bincount(point, minlength=ends), 1)
        often = entries_of(mean[palm] + _EVERYWHERE * mean[palm].mean(), _FAVOURED_ENTRIES)
        return make_struct(Steer, steer, palm_points=wp.array(np.repeat(palm, often), dtype=wp.int32, device=d))

    return context.once("place", make, context.steered, context.policy, context.bounds)


def best_poses(proposals: Any, values: Any, first: wp.array, context: Context) -> tuple[PoseTable, Tally]:
    """The poses that can hold, in candidate order, and counts ``tried``, ``blocked`` (by static links), ``kept``.

    Args:
        proposals: struct ProposedPoses. values: struct PlaceValues.
        first: candidate of row 0, (1,).
    """
    d, (count, _, groups) = context.device, proposals.anchor.shape
    chosen, upto = (wp.empty(count, dtype=wp.int32, device=d) for _ in range(2))
    tally = empty_tally(PlaceCount, d)
    asked = [context.hand.struct, context.object.struct, values, proposals]
    wp.launch(choose_poses, count, asked, [chosen, upto, tally.device], device=d)
    running_sums(upto)
    table = PoseTable.empty(d, count, groups)
    wp.launch(take_poses, count, [upto, chosen, first, proposals], [table.struct], device=d)
    return table, tally

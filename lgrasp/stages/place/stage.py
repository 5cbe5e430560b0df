"""place: candidate indices -> object poses in the hand base frame that static links do not block."""

from collections.abc import Mapping

import warp as wp

from lgrasp.errors import ConfigError
from lgrasp.field.arrays import FieldArrays
from lgrasp.grasp.tables import PoseTable
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.runtime.tally import Tally
from lgrasp.stages.context import Context
from lgrasp.stages.place.choose import best_poses
from lgrasp.stages.place.favoured import favoured_palm
from lgrasp.stages.place.kernels import propose_poses
from lgrasp.stages.place.opposed_kernels import propose_opposed
from lgrasp.stages.place.params import SOURCES, PlaceParams
from lgrasp.stages.place.predicted_kernels import propose_predicted
from lgrasp.stages.place.structs import PlaceValues, ProposedPoses

VERSION = 11


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
    tried = (params.policy_proposals or context.networks.proposals) if rated else params.proposals
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
            steer = favoured_palm(values, context)
        kernel, asked = propose_poses, [values, steer, context.networks.reach]
    elif context.predicted is None:
        kernel, asked = propose_opposed, [context.held.struct, values]
    else:
        kernel, asked = propose_predicted, [context.held.struct, context.predicted.struct, values]
    wp.launch(kernel, shape, [hand, field, obj, *asked, *where], [proposals], device=d)
    return best_poses(proposals, values, first, context)


def _shares(params: PlaceParams, learnt: Mapping[str, float], field: FieldArrays, *, palm: bool) -> dict[str, float]:
    """Share of each source in the proposals, by weight and by what it was ``learnt`` to be worth; where the palm must
    touch, of those that put the object on it."""
    weights = {name: getattr(params, name) for name in SOURCES}
    if palm:
        on_palm = bool((field.model.pair_slot < 0).any(1).all())  # pairs of a lone finger and the palm
        weights |= {"canonical": 0.0, "exhaustive": 0.0, "palm": params.palm or 1.0}
        weights["pinch"] = params.pinch if on_palm else 0.0
    weights = {name: weight * learnt.get(name, 1.0) for name, weight in weights.items()}
    total = sum(weights.values())
    if total <= 0:
        raise ConfigError("place: weights canonical, exhaustive, pinch and palm are all 0; one must be positive")
    return {name: weights[name] / total for name in ("canonical", "pinch", "palm")}

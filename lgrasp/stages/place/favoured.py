"""The palm's contact points that objects are put on more often: those where a policy expects more grasps."""

import numpy as np
import warp as wp

from lgrasp.geometry.shares import entries_of
from lgrasp.runtime.fetch import to_numpy
from lgrasp.runtime.structs import empty_struct, make_struct
from lgrasp.stages.context import Context
from lgrasp.stages.place.kernels import propose_poses
from lgrasp.stages.place.rating import rated_chance
from lgrasp.stages.place.structs import PlaceValues, ProposedPoses
from lgrasp.steer.arrays import Steer

_DRAWS = 128  # poses for each point of the palm
_SEED = 1  # of these: the same in all shards
_ENTRIES = 4096  # of the list that points are drawn from
_EVERYWHERE = 0.6  # of the mean chance, added to that of each point


def favoured_palm(values: PlaceValues, context: Context) -> Steer:
    """What is asked, with each contact point of the palm as often as the policy's mean chance of poses on it says.

    Made once for a job. For policies that go by distances alone, which rate many poses in no time.
    """

    def make() -> Steer:
        d, steer = context.device, context.steered.struct
        palm = to_numpy(steer.palm_points)
        shape = (len(palm), _DRAWS)
        proposals = empty_struct(ProposedPoses, d, *shape, context.hand.model.groups)
        on_palm = make_struct(PlaceValues, values, canonical=0.0, pinch=0.0, palm=1.0, policy_temperature=0.0)
        models = [context.hand.struct, context.field.struct, context.object.struct]
        where = [wp.full(1, at, dtype=wp.int32, device=d) for at in (_SEED, 0)]
        asked = [on_palm, steer, context.networks.reach]
        wp.launch(propose_poses, shape, [*models, *asked, *where], [proposals], device=d)
        chance = rated_chance(to_numpy(proposals.rating)).ravel()
        if not chance.any():
            return steer
        point, ends = to_numpy(proposals.palm_point).ravel(), int(palm.max()) + 1
        mean = np.bincount(point, chance, ends) / np.maximum(np.bincount(point, minlength=ends), 1)
        often = entries_of(mean[palm] + _EVERYWHERE * mean[palm].mean(), _ENTRIES)
        return make_struct(Steer, steer, palm_points=wp.array(np.repeat(palm, often), dtype=wp.int32, device=d))

    return context.once("place", make, context.steered, context.policy, context.bounds)

"""Kernels of the domain stage that drop poses which a policy finds unlikely to give a grasp."""

import warp as wp

from lgrasp.grasp.structs import Candidates, State
from lgrasp.object.arrays import Object
from lgrasp.policy.arrays import Network, wide
from lgrasp.policy.model import MOST_HITS
from lgrasp.policy.score import COUNT_SCALE, add_count, add_group, begin, finish, hit_channels
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

BLOCK = 64
"""Candidates among which poses are compared; batches are whole blocks."""

_ROUNDS = wp.constant(6)  # of the fixed point


@wp.kernel
def rate_contacts(
    hand_groups: wp.int32,
    obj: Object,
    net: Network,
    candidates: Candidates,
    chance_out: wp.array(dtype=wp.float32),
):
    """Chance that a pose gives a grasp, by the contacts realised there.

    Args:
        chance_out: (P,), 0 where no contact is realised.
    """
    row = wp.tid()
    poses = candidates.poses
    if row >= poses.rows[0]:
        return
    T = poses.pose[row]
    com = wp.transform_point(T, obj.com)
    h = begin(net, com, poses.palm_point[row])
    contacts = int(0)
    for g in range(hand_groups):
        total = wide(0.0)
        top = wide(0.0)
        hits = int(0)
        realised = int(0)
        for m in range(candidates.count[row, g]):
            if candidates.state[row, g, m] == State.REALISED:
                realised += 1
                if hits < MOST_HITS:
                    i = candidates.surface[row, g, m]
                    p = wp.transform_point(T, obj.contact_points[i])
                    x = hit_channels(net, p, -wp.transform_vector(T, obj.contact_normals[i]), com)
                    total += x
                    top = wp.max(top, x)
                    hits += 1
        contacts += realised
        h = add_count(net, h, g, float(realised) / COUNT_SCALE)
        if hits > 0:
            h = add_group(net, h, g, total / float(hits), top)
    chance = float(0.0)
    if contacts > 0:
        chance = 1.0 / (1.0 + wp.exp(-finish(net, h)))
    chance_out[row] = chance


@wp.kernel
def drop_unlikely(chance: wp.array(dtype=wp.float32), later_cost: wp.float32, candidates_out: Candidates):
    """Poses lose their contacts where going on costs more than it yields on average in their block.

    Chances per cost are highest when a pose goes on if its chance is at least the rate of its block times the cost of
    going on: a fixed point.

    Args:
        chance: that a pose gives a grasp, (P,).
        later_cost: of going on, in units of what a pose has cost so far.
    """
    row = wp.tid()
    rows = candidates_out.poses.rows[0]
    if row >= rows:
        return
    block = candidates_out.poses.index[row] // BLOCK
    a = row
    while a > 0 and candidates_out.poses.index[wp.max(a - 1, 0)] // BLOCK == block:
        a -= 1
    b = row + 1
    while b < rows and candidates_out.poses.index[wp.min(b, rows - 1)] // BLOCK == block:
        b += 1
    rate = float(0.0)
    for _r in range(_ROUNDS):
        gain = float(0.0)
        cost = float(b - a)
        for k in range(a, b):
            if chance[k] >= rate * later_cost:
                gain += chance[k]
                cost += later_cost
        rate = gain / cost
    if chance[row] < rate * later_cost:
        for g in range(candidates_out.count.shape[1]):
            candidates_out.count[row, g] = 0

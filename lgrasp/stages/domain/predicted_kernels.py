"""Kernel of the domain stage for predicted postures: they are candidates too."""

import warp as wp

from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.grasp.predicted import Predicted, touching_points
from lgrasp.grasp.structs import Candidates, State
from lgrasp.hand.arrays import Hand
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def add_predicted(
    hand: Hand,
    obj: Object,
    held: Held,
    predicted: Predicted,
    keep: wp.int32,
    candidates_out: Candidates,
):
    """The contact that a finger makes in its predicted posture, as its last candidate; over poses and groups.

    Fingers that are no side of the space, or cannot move, get none.
    """
    row, g = wp.tid()
    poses = candidates_out.poses
    if row >= poses.rows[0]:
        return
    h = poses.index[row] // held.tries
    sides = held.sides[h]
    if (g != sides[0] and g != sides[1]) or group_fixed(hand, held, h, g):
        return
    posture = with_frozen(hand, held, h, g, predicted.posture[poses.index[row], g])
    c, _p, _n, i = touching_points(hand, obj, poses.pose[row], poses.setting[row], g, posture)
    if i < 0:
        return
    record = predicted.record[c]
    if record < 0:
        return
    m = wp.min(candidates_out.count[row, g], keep - 1)
    candidates_out.surface[row, g, m] = i
    candidates_out.record[row, g, m] = record
    candidates_out.q[row, g, m] = posture
    candidates_out.state[row, g, m] = State.DRAWN
    candidates_out.count[row, g] = m + 1

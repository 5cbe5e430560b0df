"""Kernel of the close stage: fingers close until they touch the object."""

from enum import IntEnum

import warp as wp

from lgrasp.grasp.collision import body_clear, finger_above, resting_plane
from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.grasp.structs import Candidates, State
from lgrasp.hand.arrays import Hand, thumb_placed
from lgrasp.math.kinematics import group_forward, point_column, vec_dof
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.wrap.kernels import near_links
from lgrasp.stages.wrap.touch import LinkTouch, WrapValues, contact_beside, fits, nearest_touch

wp.set_module_options(KERNEL_OPTIONS)

_LINKS = wp.constant(6)  # most links of a finger that are looked at
_HALVINGS = wp.constant(3)  # of the step in which a finger meets the object
_SLIDES = wp.constant(2)  # of a touch, each time
_STRAIGHT = wp.constant(0.001)  # [m] that a touch comes nearer on the whole way, at least


class CloseCount(IntEnum):
    """Counts of the stage."""

    TRIED = 0
    TOUCHING = 1


@wp.struct
class CloseValues:
    """CloseParams and GraspBounds as kernels read them, but for what they share with stage wrap."""

    steps: wp.int32
    settings: wp.int32
    min_contacts: wp.int32
    record: wp.array(dtype=wp.int32)  # (r,) a contact vector of the field for each run of points that may touch


@wp.func
def _shares(hand: Hand, g: wp.int32):
    """True if joints of a finger are shared with others."""
    return hand.kin.dof_free[g] < hand.kin.dof_first[g + 1] - hand.kin.dof_first[g]


@wp.func
def _way(hand: Hand, g: wp.int32, setting: wp.int32):
    """A finger wide open, and how its joints move until it is closed: from one limit to the other, the farther one of
    the open posture."""
    first = hand.kin.dof_first[g]
    q = vec_dof()
    way = vec_dof()
    for d in range(hand.kin.dof_first[g + 1] - first):
        q[d] = hand.kin.dof_setting[setting, first + d]
        if d < hand.kin.dof_free[g]:
            low = hand.kin.dof_lower[first + d]
            high = hand.kin.dof_upper[first + d]
            opens_low = q[d] - low < high - q[d]
            q[d] = wp.where(opens_low, low, high)
            way[d] = wp.where(opens_low, high - low, low - high)
    return q, way


@wp.func
def _speed(hand: Hand, j0: wp.int32, j: wp.int32, way: vec_dof, X: wp.array(dtype=wp.transform), p: wp.vec3):
    """How the point p of body j moves along the way [m]."""
    v = wp.vec3()
    k = j
    while k >= 0:
        v += way[hand.kin.joint_dof[j0 + k]] * point_column(hand.kin, j0 + k, X[k], p)
        k = hand.kin.joint_parent[j0 + k]
    return v


@wp.func
def _meets(
    hand: Hand,
    obj: Object,
    g: wp.int32,
    q: vec_dof,
    way: vec_dof,
    T_object: wp.transform,
    X: wp.array(dtype=wp.transform),
):
    """True if what moves of a finger is in the object at q; X gets the poses of its bodies."""
    j0 = group_forward(hand.kin, g, q, X, 0)
    moves = bool(False)
    for j in range(hand.kin.joint_first[g + 1] - j0):
        moves = moves or way[hand.kin.joint_dof[j0 + j]] != 0.0
        if moves and not body_clear(hand, obj, 1 + j0 + j, T_object * X[j], 0.0):
            return True
    return False


@wp.func
def _touching(
    hand: Hand,
    obj: Object,
    runs: PalmarRuns,
    params: WrapValues,
    most: wp.int32,
    g: wp.int32,
    setting: wp.int32,
    pose: wp.transform,
    X: wp.array(dtype=wp.transform),
    touch: wp.array(dtype=LinkTouch),
):
    """Closes a finger until a link touches: (posture, entry of ``touch``, -1 if none can); X holds its bodies then."""
    T_object = wp.transform_inverse(pose)
    q, way = _way(hand, g, setting)
    size = 1.0 / float(most)
    steps = int(0)
    while steps <= most and not _meets(hand, obj, g, q + way * (size * float(steps)), way, T_object, X):
        steps += 1
    if steps == 0 or steps > most:
        return q, int(-1)
    t = size * float(steps - 1)
    for _h in range(_HALVINGS):
        size *= 0.5
        if not _meets(hand, obj, g, q + way * (t + size), way, T_object, X):
            t += size
    j0 = group_forward(hand.kin, g, q + way * t, X, 0)
    n = near_links(hand, obj, runs, params, g, T_object, X, touch)
    for _it in range(wp.where(n == 0, 0, params.iterations + 1)):
        first = int(0)
        for i in range(n):
            T = T_object * X[runs.body[touch[i].run] - 1 - j0]
            touch[i] = nearest_touch(hand, obj, runs, T, touch[i], _SLIDES)
            if touch[i].gap < touch[first].gap:
                first = i
        j = runs.body[touch[first].run] - 1 - j0
        if fits(hand, runs, params, T_object * X[j], touch[first]):
            return q + way * t, first
        speed = _speed(hand, j0, j, way, X, wp.transform_point(X[j], touch[first].local))
        nearing = -wp.dot(speed, wp.transform_vector(pose, touch[first].normal))
        if nearing < _STRAIGHT:
            break
        t = wp.clamp(t + (touch[first].gap + params.contact_indentation) / nearing, 0.0, 1.0)
        group_forward(hand.kin, g, q + way * t, X, 0)
    return q, int(-1)


@wp.func
def _close(
    hand: Hand,
    obj: Object,
    runs: PalmarRuns,
    params: WrapValues,
    closing: CloseValues,
    row: wp.int32,
    g: wp.int32,
    setting: wp.int32,
    candidates_out: Candidates,
    counts_out: wp.array(dtype=wp.int32),
):
    """1 if a finger touches as it closes, and its candidate, else 0."""
    pose = candidates_out.poses.pose[row]
    X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
    touch = wp.zeros(shape=(_LINKS,), dtype=LinkTouch)
    candidates_out.count[row, g] = 0
    wp.atomic_add(counts_out, int(CloseCount.TRIED), 1)
    q, i = _touching(hand, obj, runs, params, closing.steps, g, setting, pose, X, touch)
    plane = resting_plane(obj, pose, candidates_out.poses.resting[row])
    if i < 0 or not thumb_placed(hand, g, X, 0) or not finger_above(hand, g, X, plane, params.min_table_distance):
        return int(0)
    r = touch[i].run
    T = wp.transform_inverse(pose) * X[runs.body[r] - 1 - hand.kin.joint_first[g]]
    surface = contact_beside(hand, obj, runs, params, T, touch[i])
    if surface < 0:
        return int(0)
    candidates_out.count[row, g] = 1
    candidates_out.surface[row, g, 0] = surface
    candidates_out.record[row, g, 0] = closing.record[r]
    candidates_out.q[row, g, 0] = q
    candidates_out.state[row, g, 0] = int(State.REALISED)
    wp.atomic_add(counts_out, int(CloseCount.TOUCHING), 1)
    return int(1)


@wp.kernel
def close_fingers(
    hand: Hand,
    obj: Object,
    runs: PalmarRuns,
    params: WrapValues,
    closing: CloseValues,
    candidates_out: Candidates,
    setting_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """One thread per pose: the contact that each finger makes as it closes, as long as enough of them can make one.

    Fingers without shared joints come first; the others try one setting of these after another, from the pose's own.

    Args:
        runs: points of links that may touch.
        setting_out: the last that was tried, (P,).
        counts_out: CloseCount, (2,).
    """
    row = wp.tid()
    groups = candidates_out.count.shape[1]
    for g in range(groups):
        candidates_out.count[row, g] = 0
    if row >= candidates_out.poses.rows[0]:
        return
    own = setting_out[row]
    alone = wp.where(candidates_out.poses.palm_point[row] >= 0, 1, 0)
    sharing = int(0)
    for g in range(groups):
        if _shares(hand, g):
            sharing += 1
    left = groups - sharing
    for g in range(groups):
        if not _shares(hand, g):
            if alone + left + sharing >= closing.min_contacts:
                alone += _close(hand, obj, runs, params, closing, row, g, own, candidates_out, counts_out)
            left -= 1
    made = alone
    for k in range(wp.min(closing.settings, hand.kin.settings)):
        if alone + sharing < closing.min_contacts or (k > 0 and made >= closing.min_contacts):
            break
        setting = own - own % hand.kin.settings + (own + k) % hand.kin.settings
        setting_out[row] = setting
        made = alone
        left = sharing
        for g in range(groups):
            if _shares(hand, g):
                candidates_out.count[row, g] = 0
                if made + left >= closing.min_contacts:
                    made += _close(hand, obj, runs, params, closing, row, g, setting, candidates_out, counts_out)
                left -= 1

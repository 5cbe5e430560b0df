"""Kernels of the domain stage: contact domains (Lightning Grasp, 5.3) from either index of the contact field."""

from enum import IntEnum
from typing import Any

import warp as wp

from lgrasp.field.arrays import Boxes, Field, boxes_pick, field_has, field_pick, field_seed
from lgrasp.grasp.collision import finger_above, resting_plane
from lgrasp.grasp.held import Held, group_fixed, with_frozen
from lgrasp.grasp.structs import Candidates, Poses, State
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_forward
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import params_struct
from lgrasp.stages.domain.params import DomainParams
from lgrasp.steer.arrays import may_touch

wp.set_module_options(KERNEL_OPTIONS)

_TABLE_SLACK = wp.constant(0.005)  # [m] that a posture may be below its least height above the table before IK
_ROUND_STRIDE = wp.constant(6133)  # between the seeds of rounds
_NEIGHBOURS = wp.constant(16.0)  # contact points before and after one, in order, that lie near it


class DomainCount(IntEnum):
    """Counts of the stage."""

    POSES = 0
    RICH = 1
    CANDIDATES = 2


DomainValues = params_struct(
    *("DomainValues", __name__, DomainParams),
    floats="cosine min_table_distance",
    groups=wp.int32,  # bit g: group g may touch
    round=wp.int32,  # 0: the first time
    stride=wp.int32,  # coprime to the number of contact points: multiples of it visit every one
)
"""DomainParams and GraspBounds as kernels read them; ``cosine``: least of hand and object normal."""


@wp.func
def _touching(poses: Poses, contacts: wp.array2d(dtype=wp.int32), row: wp.int32):
    """How many fingers have contacts at a pose, and the palm."""
    touching = wp.where(poses.palm_point[row] >= 0, 1, 0)
    for g in range(contacts.shape[1]):
        touching += wp.where(contacts[row, g] > 0, 1, 0)
    return touching


@wp.kernel
def count_realised(candidates: Candidates, realised_out: wp.array2d(dtype=wp.int32)):
    """How many contacts of each group are realised.

    Args:
        realised_out: (P, G).
    """
    row, g = wp.tid()
    if row >= candidates.poses.rows[0]:
        return
    n = int(0)
    for m in range(candidates.count[row, g]):
        if candidates.state[row, g, m] == State.REALISED:
            n += 1
    realised_out[row, g] = n


def _drawing(voxels: bool) -> Any:
    """The drawing kernel for one index."""

    @wp.kernel
    def draw_domains(
        hand: Hand,
        field: Field,
        boxes: Boxes,
        obj: Object,
        params: DomainValues,
        seed: wp.array(dtype=wp.int32),
        realised: wp.array2d(dtype=wp.int32),
        candidates_out: Candidates,
    ):
        """Contact domain of each (pose, group): surface points that a contact vector of the group meets.

        In later rounds groups that have few realised contacts keep those, and get new candidates in place of others.

        Args:
            seed: of the stage, (1,).
            realised: contacts of each group, (P, G); not read in round 0.
        """
        row, g = wp.tid()
        poses = candidates_out.poses
        if row >= poses.rows[0]:
            return
        if not may_touch(params.groups, g):
            candidates_out.count[row, g] = 0
            return
        n = int(0)
        if params.round > 0:
            enough = realised[row, g] >= wp.min(params.enough, params.keep)
            if enough or _touching(poses, realised, row) < params.fingers:
                return
            for m in range(candidates_out.count[row, g]):
                if candidates_out.state[row, g, m] == State.REALISED:
                    candidates_out.surface[row, g, n] = candidates_out.surface[row, g, m]
                    candidates_out.record[row, g, n] = candidates_out.record[row, g, m]
                    candidates_out.q[row, g, n] = candidates_out.q[row, g, m]
                    candidates_out.state[row, g, n] = State.REALISED
                    n += 1
        slot = poses.setting[row] * hand.kin.groups + g
        state = wp.rand_init(seed[0] + params.round * _ROUND_STRIDE, poses.index[row] * hand.kin.groups + g)
        R = wp.transform_get_rotation(poses.pose[row])
        t = wp.transform_get_translation(poses.pose[row])
        plane = resting_plane(obj, poses.pose[row], poses.resting[row])
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        i = int(0)
        attempts = params.attempts
        if wp.static(not voxels):
            # every point once at most, spread over the surface
            i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
            attempts = wp.min(attempts, obj.contacts)
        for a in range(attempts):
            if wp.static(voxels):
                near = poses.anchor[row, g]
                if n > 0:
                    near = candidates_out.surface[row, g, a % n]
                if a < attempts // 2 or near < 0:
                    i = wp.min(int(wp.randf(state) * float(obj.contacts)), obj.contacts - 1)
                else:
                    # few were found all over the surface: look about those
                    move = int(wp.randf(state) * (2.0 * _NEIGHBOURS + 1.0)) - int(_NEIGHBOURS)
                    i = wp.clamp(near + move, 0, obj.contacts - 1)
            else:
                i = (i + params.stride) % obj.contacts
            p = wp.quat_rotate(R, obj.contact_points[i]) + t
            normal = -wp.quat_rotate(R, obj.contact_normals[i])
            record = int(-1)
            if wp.static(voxels):
                at = field_has(field, slot, p, normal)
                if at >= 0:
                    pick = field_pick(field, slot, at, p, normal, wp.rand_init(wp.randi(state)))
                    if float(pick[1]) * 0.0001 >= params.cosine:
                        record = pick[0]
            else:
                record = boxes_pick(boxes, field, slot, p, normal, params.cosine, wp.rand_init(wp.randi(state)))
            if record >= 0 and obj.resting.count > 0:
                group_forward(hand.kin, g, field_seed(field, hand.kin, slot, record), X, 0)
                if not finger_above(hand, g, X, plane, params.min_table_distance - _TABLE_SLACK):
                    record = int(-1)
            if record >= 0:
                candidates_out.surface[row, g, n] = i
                candidates_out.record[row, g, n] = record
                candidates_out.q[row, g, n] = field_seed(field, hand.kin, slot, record)
                candidates_out.state[row, g, n] = State.DRAWN
                n += 1
                if n == params.keep:
                    break
        candidates_out.count[row, g] = n

    return draw_domains


draw_domains = {"voxel": _drawing(True), "bvh": _drawing(False)}
"""Kernels by index. ``bvh``, as published, asks every patch of the group about points all over the surface."""


@wp.kernel
def keep_frozen(hand: Hand, held: Held, candidates_out: Candidates):
    """Groups that must stay as they are lose their candidates; seeds of others take over what is frozen."""
    row, g = wp.tid()
    if row >= candidates_out.poses.rows[0]:
        return
    h = candidates_out.poses.index[row] // held.tries
    if group_fixed(hand, held, h, g):
        candidates_out.count[row, g] = 0
    for m in range(candidates_out.count[row, g]):
        candidates_out.q[row, g, m] = with_frozen(hand, held, h, g, candidates_out.q[row, g, m])


@wp.kernel
def drop_poor(params: DomainValues, candidates_out: Candidates, counts_out: wp.array(dtype=wp.int32)):
    """Poses where too few fingers (and the palm) can touch lose their candidates.

    Args:
        counts_out: DomainCount, (3,).
    """
    row = wp.tid()
    if row >= candidates_out.poses.rows[0]:
        return
    groups = candidates_out.count.shape[1]
    candidates = int(0)
    for g in range(groups):
        candidates += candidates_out.count[row, g]
    wp.atomic_add(counts_out, DomainCount.POSES, 1)
    if _touching(candidates_out.poses, candidates_out.count, row) >= params.fingers:
        wp.atomic_add(counts_out, DomainCount.RICH, 1)
        wp.atomic_add(counts_out, DomainCount.CANDIDATES, candidates)
    else:
        for g in range(groups):
            candidates_out.count[row, g] = 0

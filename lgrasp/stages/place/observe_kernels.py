"""Kernel that looks what the fingers can reach at poses."""

import warp as wp

from lgrasp.field.arrays import Field
from lgrasp.grasp.collision import resting_plane
from lgrasp.grasp.structs import Poses
from lgrasp.hand.arrays import Hand
from lgrasp.math.limits import MAX_GROUPS
from lgrasp.math.sdf import sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.stages.place.rating import MAX_HITS, find_reach

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class ReachRows:
    """Reachable contacts of P poses, those of a group side by side; base frame."""

    points: wp.array2d(dtype=wp.vec3)  # (P, H) [m]
    normals: wp.array2d(dtype=wp.vec3)  # (P, H)
    owner: wp.array2d(dtype=wp.int32)  # (P, H) group, -1 unused
    share: wp.array2d(dtype=wp.float32)  # (P, G) of the points drawn for a group that are hits
    distances: wp.array2d(dtype=wp.float32)  # (P, M) of the object [m]


@wp.kernel
def find_all(
    hand: Hand,
    field: Field,
    obj: Object,
    samples: wp.int32,
    groups: wp.int32,
    poses: Poses,
    at: wp.array(dtype=wp.vec3),
    seed: wp.int32,
    reach_out: ReachRows,
):
    """Reachable contacts at each pose, and the object's distances.

    Args:
        at: where the distances are asked, base frame (M,).
    """
    row = wp.tid()
    if row >= poses.rows[0]:
        return
    points = wp.zeros(shape=(MAX_HITS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_HITS,), dtype=wp.vec3)
    owner = wp.zeros(shape=(MAX_HITS,), dtype=wp.int32)
    share = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.float32)
    anchor = wp.zeros(shape=(MAX_GROUPS,), dtype=wp.int32)
    for g in range(hand.kin.groups):
        anchor[g] = poses.anchor[row, g]
    T = poses.pose[row]
    plane = resting_plane(obj, T, poses.resting[row])
    setting = poses.setting[row]
    state = wp.rand_init(seed, row)
    m = find_reach(hand, field, obj, samples, groups, T, plane, setting, anchor, points, normals, owner, share, state)
    for k in range(m):
        reach_out.points[row, k] = points[k]
        reach_out.normals[row, k] = normals[k]
        reach_out.owner[row, k] = owner[k]
    for g in range(hand.kin.groups):
        reach_out.share[row, g] = share[g]
    T_object = wp.transform_inverse(T)
    for k in range(at.shape[0]):
        reach_out.distances[row, k] = sdf_value(obj.sdf, wp.transform_point(T_object, at[k]))

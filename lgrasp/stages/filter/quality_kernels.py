"""Kernels that finish grasps: balance, quality, and packing of the rows that are kept."""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hand.self_collision import overlap_depth
from lgrasp.math.constants import BALANCED, CONE_EDGES
from lgrasp.math.qp import MAX_CONTACTS, balance, unresisted
from lgrasp.math.quality import epsilon_bound
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_EDGES = wp.constant(CONE_EDGES)
_BALANCED = wp.constant(BALANCED)
_NARROWER = wp.constant(2)  # cones tried before the full one
_SLACK = wp.constant(1.0e-3)  # by which their residual may be larger


@wp.func
def _contacts(
    obj: Object,
    surfaces: wp.array(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
):
    """Points and inward normals of a set's contacts in the object's frame; returns their number."""
    k = int(0)
    for c in range(surfaces.shape[0]):
        if surfaces[c] >= 0:
            points[k] = obj.contact_points[surfaces[c]]
            normals[k] = -obj.contact_normals[surfaces[c]]
            k += 1
    return k


@wp.func
def _balanced(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    k: wp.int32,
    friction: wp.float32,
    edges: wp.int32,
    torque_scale: wp.float32,
    stop: wp.float32,
    forces: wp.array(dtype=wp.vec3),
):
    """:func:`balance` about the contacts' centroid."""
    centroid = wp.vec3(0.0)
    for c in range(k):
        centroid = centroid + points[c]
    arms = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    for c in range(k):
        arms[c] = points[c] - centroid / float(k)
    return balance(arms, normals, k, friction, edges, torque_scale, stop, forces)


@wp.kernel
def balance_grasps(
    obj: Object,
    friction: wp.float32,
    balanced: wp.float32,
    torque_scale: wp.float32,
    max_depth: wp.float32,
    contact_surface: wp.array2d(dtype=wp.int32),
    depth: wp.array(dtype=wp.float32),
    outcome_out: wp.array(dtype=wp.int32),
    force_out: wp.array2d(dtype=wp.vec3),
    fswo_out: wp.array(dtype=wp.float32),
    gswo_out: wp.array(dtype=wp.float32),
):
    """FSWO (eq. 1), GSWO (eq. 2, 8-edge cones) and its forces, object frame."""
    i = wp.tid()
    if outcome_out[i] != 0:
        return
    if depth[i] > max_depth:
        outcome_out[i] = 3
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(obj, contact_surface[i], points, normals)
    fswo_out[i] = _balanced(points, normals, k, 0.0, 0, torque_scale, 0.0, forces)
    gswo = _balanced(points, normals, k, friction, _EDGES, torque_scale, _BALANCED, forces)
    gswo_out[i] = gswo
    if gswo > balanced:
        outcome_out[i] = 5
        return
    for c in range(k):
        force_out[i, c] = forces[c]


@wp.kernel
def resist_loads(
    obj: Object,
    friction: wp.float32,
    most: wp.float32,
    pose: wp.array(dtype=wp.transform),
    set_pose: wp.array(dtype=wp.int32),
    contact_surface: wp.array2d(dtype=wp.int32),
    outcome: wp.array(dtype=wp.int32),
    disturbance_out: wp.array(dtype=wp.float32),
):
    """One thread per (direction, set): the disturbance residual grows to the worst direction's."""
    direction, i = wp.tid()
    worst = disturbance_out[i]
    if outcome[i] != 0 or worst > most:
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(obj, contact_surface[i], points, normals)
    for c in range(k):
        points[c] = points[c] - obj.com
    turn = wp.quat_inverse(wp.transform_get_rotation(pose[set_pose[i]]))
    wp.atomic_max(disturbance_out, i, unresisted(points, normals, k, friction, turn, direction, worst, most))


@wp.kernel
def center_forces(
    obj: Object,
    friction: wp.float32,
    torque_scale: wp.float32,
    contact_surface: wp.array2d(dtype=wp.int32),
    gswo: wp.array(dtype=wp.float32),
    rows: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    force_out: wp.array2d(dtype=wp.vec3),
):
    """Balancing forces of the kept rows in the narrowest of a few round cones that balances as well."""
    i = wp.tid()
    if i >= rows[0]:
        return
    s = row[i]
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    forces = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(obj, contact_surface[s], points, normals)
    goal = gswo[s] + _SLACK
    for step in range(_NARROWER):
        mu = friction * (float(step) + 1.0) / float(_NARROWER + 1)
        if _balanced(points, normals, k, mu, 0, torque_scale, goal - 0.5 * _SLACK, forces) <= goal:
            for c in range(k):
                force_out[s, c] = forces[c]
            break


@wp.kernel
def count_outcomes(
    most: wp.float32,
    disturbance: wp.array(dtype=wp.float32),
    outcome_out: wp.array(dtype=wp.int32),
    kept_out: wp.array(dtype=wp.int32),
    counts_out: wp.array(dtype=wp.int32),
):
    """1 for sets that passed, disturbance included; ``counts_out`` grows by the sets of each outcome."""
    i = wp.tid()
    if outcome_out[i] == 0 and disturbance[i] > most:
        outcome_out[i] = 6
    kept_out[i] = wp.where(outcome_out[i] == 0, 1, 0)
    wp.atomic_add(counts_out, outcome_out[i], 1)


@wp.kernel
def list_kept(
    outcome: wp.array(dtype=wp.int32),
    upto: wp.array(dtype=wp.int32),
    row_out: wp.array(dtype=wp.int32),
):
    """The sets that passed, ``upto[i]`` of them among the first ``i + 1``."""
    i = wp.tid()
    if outcome[i] == 0:
        row_out[upto[i] - 1] = i


@wp.kernel
def grasp_epsilon(
    obj: Object,
    seed: wp.array(dtype=wp.int32),
    friction: wp.float32,
    contact_surface: wp.array2d(dtype=wp.int32),
    rows: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    epsilon_out: wp.array(dtype=wp.float32),
):
    """Ferrari-Canny bound of the kept rows, about the object's centre of mass."""
    i = wp.tid()
    if i >= rows[0]:
        return
    points = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    normals = wp.zeros(shape=(MAX_CONTACTS,), dtype=wp.vec3)
    k = _contacts(obj, contact_surface[row[i]], points, normals)
    for c in range(k):
        points[c] = points[c] - obj.com
    epsilon_out[i] = epsilon_bound(points, normals, k, friction, obj.radius, wp.rand_init(seed[0]))


@wp.kernel
def self_overlap(
    hand: Hand,
    body: wp.array2d(dtype=wp.transform),
    rows: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    depth_out: wp.array(dtype=wp.float32),
):
    """Overlap of links in the kept rows: of pairs that nearly always touch; all others are apart."""
    i = wp.tid()
    if i >= rows[0]:
        return
    depth_out[i] = overlap_depth(hand, body, row[i])


@wp.kernel
def pack_rows(
    hand: Hand,
    obj: Object,
    pose: wp.array(dtype=wp.transform),
    set_pose: wp.array(dtype=wp.int32),
    contact: wp.array2d(dtype=wp.int32),
    contact_surface: wp.array2d(dtype=wp.int32),
    force: wp.array2d(dtype=wp.vec3),
    index: wp.array(dtype=wp.int32),
    set_slot: wp.array(dtype=wp.int32),
    numbers: wp.array2d(dtype=wp.float32),
    rows: wp.array(dtype=wp.int32),
    row: wp.array(dtype=wp.int32),
    pose_out: wp.array(dtype=wp.transform),
    point_out: wp.array2d(dtype=wp.vec3),
    normal_out: wp.array2d(dtype=wp.vec3),
    link_out: wp.array2d(dtype=wp.int32),
    force_out: wp.array2d(dtype=wp.vec3),
    index_out: wp.array(dtype=wp.int32),
    slot_out: wp.array(dtype=wp.int32),
    numbers_out: wp.array2d(dtype=wp.float32),
):
    """Pose and contacts of the kept rows; NaN and -1 where there is no contact."""
    i = wp.tid()
    if i >= rows[0]:
        return
    s = row[i]
    pose_out[i] = pose[set_pose[s]]
    index_out[i] = index[set_pose[s]]
    slot_out[i] = set_slot[s]
    for k in range(numbers.shape[0]):
        numbers_out[k, i] = numbers[k, s]
    for k in range(contact.shape[1]):
        c = contact[s, k]
        if c >= 0:
            point_out[i, k] = obj.contact_points[contact_surface[s, k]]
            normal_out[i, k] = obj.contact_normals[contact_surface[s, k]]
            link_out[i, k] = hand.contacts.link[c]
            force_out[i, k] = force[s, k]
        else:
            none = wp.vec3(wp.nan, wp.nan, wp.nan)
            point_out[i, k] = none
            normal_out[i, k] = none
            force_out[i, k] = none
            link_out[i, k] = -1

"""Kernels that find where hands in a posture touch an object: the nearest allowed point of each link."""

import warp as wp

from lgrasp.grasp.check_kernels import contact_fit
from lgrasp.grasp.check_structs import Limits
from lgrasp.grasp.collision import body_far
from lgrasp.hand.arrays import Hand
from lgrasp.math.kinematics import group_dofs, group_forward
from lgrasp.math.limits import MAX_JOINTS
from lgrasp.math.sdf import sdf_gradient, sdf_value
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_NORMAL_REACH = wp.constant(0.006)  # [m] from a contact point of the object whose normal stands for that of its surface
_MAX_RUNS = wp.constant(64)
_MAX_GROUPS = wp.constant(16)
_SECOND_CONTACT_OFFSET = wp.constant(1.0e3)  # [m] by which a group's second contact comes after all first ones


@wp.struct
class PalmarRuns:
    """Points of a hand that may touch, those of one link together: r runs of points."""

    points: wp.array(dtype=wp.vec3)  # (p,) body's frame [m]
    normals: wp.array(dtype=wp.vec3)  # (p,) outward
    first: wp.array(dtype=wp.int32)  # (r + 1,)
    body: wp.array(dtype=wp.int32)  # (r,)
    link: wp.array(dtype=wp.int32)  # (r,) index in link_names
    grid: wp.array(dtype=wp.int32)  # (r,) mesh of the link, -1 none
    place: wp.array(dtype=wp.int32)  # (r,) contact point of the hand that stands for the run


@wp.struct
class RunContacts:
    """Findings on n hands, run by run."""

    gap: wp.array2d(dtype=wp.float32)  # (n, r) [m], -1 without contact
    surface: wp.array2d(dtype=wp.int32)  # (n, r) contact point of the object


@wp.kernel
def link_contacts(
    hand: Hand,
    obj: Object,
    limits: Limits,
    runs: PalmarRuns,
    pose: wp.array(dtype=wp.transform),
    q: wp.array2d(dtype=wp.float32),
    found_out: RunContacts,
):
    """One thread per (run, hand): its nearest point that faces the object within the limits, if there is one.

    The contact on the object is a contact point, whose normal is true: of those within the limits the one nearest to
    the foot of the perpendicular.

    Args:
        pose: (n,) T_hand_object.
        q: (n, K) joint positions [rad or m].
    """
    s, i = wp.tid()
    found_out.gap[i, s] = -1.0
    T_object = wp.transform_inverse(pose[i])
    g = hand.body_group[runs.body[s]]
    B = wp.transform_identity()
    if g >= 0:
        X = wp.zeros(shape=(MAX_JOINTS,), dtype=wp.transform)
        first = group_forward(hand.kin, g, group_dofs(hand.kin, g, q, i), X, 0)
        B = X[runs.body[s] - 1 - first]
    T = T_object * B
    if body_far(hand, obj, runs.body[s], T, limits.max_gap):
        return
    best = limits.max_gap
    c = int(-1)
    for k in range(runs.first[s], runs.first[s + 1]):
        p = wp.transform_point(T, runs.points[k])
        d = wp.abs(sdf_value(obj.sdf, p))
        if d < best:
            e = sdf_gradient(obj.sdf, p)
            n = wp.vec3(e[0], e[1], e[2])
            if wp.dot(n, wp.transform_vector(T, runs.normals[k])) < -limits.min_cosine:
                best = d
                c = k
    if c < 0:
        return
    p = wp.transform_point(T, runs.points[c])
    e = sdf_gradient(obj.sdf, p)
    n = wp.vec3(e[0], e[1], e[2])
    foot = p - n * e[3]
    near = float(_NORMAL_REACH)
    for k in range(obj.contacts):
        far = wp.length(obj.contact_points[k] - foot)
        if far >= near:
            continue
        m = obj.contact_normals[k]
        if wp.dot(m, n) <= limits.min_spread_cosine:
            continue
        gap = best
        facing = -wp.dot(m, wp.transform_vector(T, runs.normals[c]))
        if runs.grid[s] >= 0:
            fit = contact_fit(hand, runs.grid[s], T, obj.contact_points[k], -m)
            gap = fit[0]
            facing = wp.min(fit[1], fit[2])
        if facing > limits.min_cosine and gap < limits.max_gap:
            near = far
            found_out.gap[i, s] = gap
            found_out.surface[i, s] = k


@wp.kernel
def choose_contacts(
    hand: Hand,
    runs: PalmarRuns,
    found: RunContacts,
    run_out: wp.array2d(dtype=wp.int32),
    surface_out: wp.array2d(dtype=wp.int32),
):
    """The contacts that are kept, C at most: the nearest of each group (palm included) first, then of the others.

    Args:
        run_out: (n, C) run that touches, -1 none.
        surface_out: (n, C) contact point of the object, -1 none.
    """
    i = wp.tid()
    taken = wp.zeros(shape=(_MAX_RUNS,), dtype=wp.int32)
    has = wp.zeros(shape=(_MAX_GROUPS,), dtype=wp.int32)
    for k in range(run_out.shape[1]):
        best = int(-1)
        least = float(1.0e30)
        for s in range(found.gap.shape[1]):
            if found.gap[i, s] >= 0.0 and taken[s] == 0:
                worth = found.gap[i, s] + _SECOND_CONTACT_OFFSET * float(has[hand.body_group[runs.body[s]] + 1])
                if worth < least:
                    least = worth
                    best = s
        run_out[i, k] = best
        surface_out[i, k] = -1
        if best >= 0:
            taken[best] = 1
            has[hand.body_group[runs.body[best]] + 1] = 1
            surface_out[i, k] = found.surface[i, best]


@wp.kernel
def tell_contacts(
    obj: Object,
    runs: PalmarRuns,
    run: wp.array2d(dtype=wp.int32),
    surface: wp.array2d(dtype=wp.int32),
    link_out: wp.array2d(dtype=wp.int32),
    point_out: wp.array(dtype=wp.vec3),
    normal_out: wp.array(dtype=wp.vec3),
):
    """Chosen contacts in words that hold without the runs.

    Args:
        run: (n, C) as of :func:`choose_contacts`, as the next.
        surface: (n, C) contact point of the object.
        link_out: (n, C) index in link_names, -1 none.
        point_out: (n * C,) on the object [m].
        normal_out: (n * C,) outward.
    """
    i, k = wp.tid()
    link_out[i, k] = -1
    if run[i, k] >= 0:
        link_out[i, k] = runs.link[run[i, k]]
        point_out[i * run.shape[1] + k] = obj.contact_points[surface[i, k]]
        normal_out[i * run.shape[1] + k] = obj.contact_normals[surface[i, k]]

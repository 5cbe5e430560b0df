"""Where links of a finger are nearest to the object, and whether they touch it there."""

import warp as wp

from lgrasp.geometry.clusters import CLUSTER_SIZE
from lgrasp.grasp.check_kernels import contact_fit
from lgrasp.grasp.contact_kernels import PalmarRuns
from lgrasp.hand.arrays import Hand, contact_allowed
from lgrasp.math.sdf import Sdf, sdf_gradient, sdf_of
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.structs import params_struct
from lgrasp.stages.wrap.params import WrapParams

wp.set_module_options(KERNEL_OPTIONS)

_DEPTH = wp.constant(0.004)  # [m] in the object, of points that links are nearest to
_SAME_FACET = wp.constant(0.9)  # cosine of the turn of a normal that does not cross an edge
_TOO_DEEP = wp.constant(0.0001)  # [m] more than a link aims to press in: the step after next is not as deep
_REACH = wp.constant(0.005)  # [m] from a touch to the contact point of the object that stands for it
_GAP_WEIGHT = wp.constant(30.0)  # [1/m] beside the cosine of the normals: 0.1 mm is worth 1 degree at 10 degrees
_WORTHLESS = wp.constant(-1.0e6)


_BOUNDS = "max_gap allowed_penetration min_self_distance min_table_distance"
WrapValues = params_struct("WrapValues", __name__, WrapParams, floats=f"cosine min_cosine min_spread_cosine {_BOUNDS}")
"""WrapParams and GraspBounds as kernels read them. Least cosines: of the normals, of these by the bounds, and of the
object's normals about a contact."""


@wp.struct
class LinkTouch:
    """Where a link is nearest to the object."""

    run: wp.int32
    local: wp.vec3  # of the link's surface, body's frame [m]
    out: wp.vec3  # outward normal of the facet there, body's frame
    foot: wp.vec3  # of the object's surface, object's frame [m]
    normal: wp.vec3  # its outward normal, object's frame
    gap: wp.float32  # [m]


@wp.func
def nearest_touch(hand: Hand, obj: Object, runs: PalmarRuns, T: wp.transform, touch: LinkTouch, slides: wp.int32):
    """The touch, slid along the link towards where it is nearest to the object, or deepest in it. T = T_object_body.

    A slide ends at the link's nearest point to one inside the object, so that it is not stuck where surfaces cross.
    """
    at = wp.transform_point(T, touch.local)
    e = sdf_gradient(obj.sdf, at)
    for _s in range(slides):
        inside = at - wp.vec3(e[0], e[1], e[2]) * (e[3] + _DEPTH)
        local = wp.transform_point(wp.transform_inverse(T), inside)
        s = sdf_gradient(sdf_of(hand.contacts.grids, runs.grid[touch.run]), local)
        out = wp.vec3(s[0], s[1], s[2])
        touch.local = local - out * s[3]
        # at an edge that of the facet before it
        if wp.dot(out, touch.out) > _SAME_FACET:
            touch.out = out
        at = wp.transform_point(T, touch.local)
        e = sdf_gradient(obj.sdf, at)
    touch.normal = wp.vec3(e[0], e[1], e[2])
    touch.gap = e[3]
    touch.foot = at - touch.normal * e[3]
    return touch


@wp.func
def fits(hand: Hand, runs: PalmarRuns, params: WrapValues, T: wp.transform, touch: LinkTouch):
    """True if a touch is a contact: within gap and angle, on surface that may touch."""
    off = touch.gap + params.contact_indentation
    if off > params.gap or off < -_TOO_DEEP:
        return False
    if wp.dot(wp.transform_vector(T, touch.out), touch.normal) > -params.cosine:
        return False
    return contact_allowed(hand.contacts, runs.grid[touch.run], touch.out)


@wp.func
def touches_there(hand: Hand, obj: Object, params: WrapValues, grid: wp.int32, T: wp.transform, k: wp.int32):
    """True if a link's mesh touches contact point k of the object as the filter will ask. T = T_object_body."""
    fit = contact_fit(hand, grid, T, obj.contact_points[k], -obj.contact_normals[k])
    return fit[0] < params.max_gap and wp.min(fit[1], fit[2]) > params.min_cosine


@wp.func
def _worth(
    obj: Object, params: WrapValues, sdf: Sdf, T: wp.transform, T_body: wp.transform, touch: LinkTouch, k: wp.int32
):
    """How well contact point k of the object stands for a touch, if it is near by. sdf: of the link."""
    p = obj.contact_points[k]
    if wp.length_sq(p - touch.foot) >= _REACH * _REACH:
        return _WORTHLESS
    s = sdf_gradient(sdf, wp.transform_point(T_body, p))
    facing = -wp.dot(wp.transform_vector(T, wp.vec3(s[0], s[1], s[2])), obj.contact_normals[k])
    if facing <= params.cosine or wp.abs(s[3]) >= params.max_gap:
        return _WORTHLESS
    if wp.dot(obj.contact_normals[k], touch.normal) <= params.min_spread_cosine:
        return _WORTHLESS
    return facing - _GAP_WEIGHT * wp.abs(s[3])


@wp.func
def contact_beside(hand: Hand, obj: Object, runs: PalmarRuns, params: WrapValues, T: wp.transform, touch: LinkTouch):
    """Contact point of the object that stands for a touch, -1 if none near by is a contact of the link's mesh."""
    best = int(-1)
    most = float(_WORTHLESS)
    sdf = sdf_of(hand.contacts.grids, runs.grid[touch.run])
    T_body = wp.transform_inverse(T)
    for run in range(obj.contact_sphere.shape[0]):
        ball = obj.contact_sphere[run]
        if wp.length(wp.vec3(ball[0], ball[1], ball[2]) - touch.foot) < _REACH + ball[3]:
            for k in range(run * CLUSTER_SIZE, wp.min((run + 1) * CLUSTER_SIZE, obj.contacts)):
                worth = _worth(obj, params, sdf, T, T_body, touch, k)
                if worth > most and touches_there(hand, obj, params, runs.grid[touch.run], T, k):
                    most = worth
                    best = k
    return best

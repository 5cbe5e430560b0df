"""What a network makes of contacts at a pose: log-odds that it gives a grasp."""

import warp as wp

from lgrasp.math.sdf import sdf_value
from lgrasp.object.arrays import Object
from lgrasp.policy.arrays import Network, wide
from lgrasp.policy.model import HIT_FEATURES, WIDTH
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_FIRST = wp.constant(HIT_FEATURES + 1)  # row where the first layer begins
HIT_SCALE = 20.0  # [1/m] of places about the centre of mass
MOMENT_SCALE = 40.0  # [1/m]
CENTRE_SCALE = 10.0  # [1/m] of the centre of mass
COUNT_SCALE = 48.0  # of the share of drawn points that are hits
DISTANCE_SCALE = 50.0  # [1/m]
DISTANCE_RANGE = (-1.0, 2.5)  # of scaled distances
_NEAREST = wp.constant(DISTANCE_RANGE[0])
_FARTHEST = wp.constant(DISTANCE_RANGE[1])


@wp.func
def _relu(x: wide):
    return wp.max(x, wide(0.0))


@wp.func
def hit_channels(net: Network, p: wp.vec3, n: wp.vec3, com: wp.vec3):
    """Channels of a contact at p with hand normal n about the centre of mass."""
    r = p - com
    m = wp.cross(r, n) * MOMENT_SCALE
    r = r * HIT_SCALE
    x = net.rows[9]
    for a in range(3):
        x += r[a] * net.rows[a] + n[a] * net.rows[3 + a] + m[a] * net.rows[6 + a]
    return _relu(x)


@wp.func
def add_group(net: Network, h: wide, g: wp.int32, mean: wide, top: wide):
    """The first layer, and what a group's hits add."""
    row = _FIRST + 2 * WIDTH * g
    for e in range(WIDTH):
        h += mean[e] * net.rows[row + e] + top[e] * net.rows[row + WIDTH + e]
    return h


@wp.func
def begin(net: Network, com: wp.vec3, palm: wp.int32):
    """The first layer of a pose with the object's centre of mass at ``com`` and perhaps a palm contact (-1: none)."""
    row = _FIRST + 2 * WIDTH * net.groups
    h = net.rows[row + 4 + net.groups + net.points.shape[0]]
    for a in range(3):
        h += com[a] * CENTRE_SCALE * net.rows[row + a]
    if palm >= 0:
        h += net.rows[row + 3]
    return h


@wp.func
def add_count(net: Network, h: wide, g: wp.int32, share: wp.float32):
    """The first layer, and what the share of a group's points that are hits adds."""
    return h + wp.log(1.0 + COUNT_SCALE * share) * net.rows[_FIRST + 2 * WIDTH * net.groups + 4 + g]


@wp.func
def add_distances(net: Network, h: wide, obj: Object, T_object: wp.transform):
    """The first layer, and what the object's distances from the points add."""
    row = _FIRST + 2 * WIDTH * net.groups + 4 + net.groups
    for k in range(net.points.shape[0]):
        d = sdf_value(obj.sdf, wp.transform_point(T_object, net.points[k])) * DISTANCE_SCALE
        h += wp.clamp(d, _NEAREST, _FARTHEST) * net.rows[row + k]
    return h


@wp.func
def finish(net: Network, h: wide):
    """Log-odds from the first layer."""
    row = _FIRST + 2 * WIDTH * net.groups + 5 + net.groups + net.points.shape[0]
    x = _relu(h)
    y = net.rows[row + WIDTH]
    for e in range(WIDTH):
        y += x[e] * net.rows[row + e]
    return wp.dot(_relu(y), net.rows[row + WIDTH + 1]) + net.rows[row + WIDTH + 2][0]

"""Warp functions on directions and rotations."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

_RES = 8
NORMAL_BINS = _RES * _RES
"""Octahedral bins of the unit sphere; a bin reaches 10 to 28 degrees from its middle."""

# Bins are turned: the axes are 8 degrees from edges. Else edges go through the normals of fingers that bend in a plane
# of the base frame, and rounding decides on which side they are.
_TURN = wp.constant(wp.mat33(-0.66, -0.54, 0.52, 0.69, -0.71, 0.14, 0.29, 0.45, 0.84))

vec3s, transforms = wp.array(dtype=wp.vec3), wp.array(dtype=wp.transform)
"""Types of local arrays that functions are given."""


@wp.func
def _sign(x: wp.float32):
    return wp.where(x >= 0.0, 1.0, -1.0)


@wp.func
def _folded(u: wp.float32, v: wp.float32, z: wp.float32):
    """The lower half of the octahedron (z < 0) folded outwards, and back."""
    if z < 0.0:
        return wp.vec2((1.0 - wp.abs(v)) * _sign(u), (1.0 - wp.abs(u)) * _sign(v))
    return wp.vec2(u, v)


@wp.func
def octahedral(n: wp.vec3):
    """Unit vector -> point of the square [-1, 1]^2."""
    s = 1.0 / (wp.abs(n[0]) + wp.abs(n[1]) + wp.abs(n[2]))
    return _folded(n[0] * s, n[1] * s, n[2])


@wp.func
def normal_bin(n: wp.vec3):
    """Index of the octahedral bin that holds unit vector n."""
    e = octahedral(_TURN * n)
    i = wp.clamp(int((e[0] + 1.0) * 0.5 * float(_RES)), 0, _RES - 1)
    j = wp.clamp(int((e[1] + 1.0) * 0.5 * float(_RES)), 0, _RES - 1)
    return i * _RES + j


@wp.func
def decode_normal(code: wp.int32):
    """Inverse of :func:`encode_normal`."""
    u = float(code // 256) / 127.5 - 1.0
    v = float(code % 256) / 127.5 - 1.0
    z = 1.0 - wp.abs(u) - wp.abs(v)
    e = _folded(u, v, z)
    return wp.normalize(wp.vec3(e[0], e[1], z))


@wp.func
def encode_normal(n: wp.vec3):
    """Unit vector -> 16 bits (octahedral, 8 + 8), the nearest of the four codes around it; error below 0.65 degrees."""
    e = octahedral(n)
    i = wp.clamp(int((e[0] + 1.0) * 127.5), 0, 254)
    j = wp.clamp(int((e[1] + 1.0) * 127.5), 0, 254)
    best = i * 256 + j
    top = wp.dot(decode_normal(best), n)
    for s in range(1, 4):
        code = (i + s // 2) * 256 + j + s % 2
        c = wp.dot(decode_normal(code), n)
        if c > top:
            top = c
            best = code
    return best


@wp.func
def tangent(n: wp.vec3):
    """n x (the axis of n's smallest component), normalised: the first edge direction of friction cones."""
    x = wp.abs(n[0])
    y = wp.abs(n[1])
    z = wp.abs(n[2])
    a = wp.vec3(0.0, 0.0, 1.0)
    if x <= y and x <= z:
        a = wp.vec3(1.0, 0.0, 0.0)
    elif y <= z:
        a = wp.vec3(0.0, 1.0, 0.0)
    return wp.normalize(wp.cross(n, a))


@wp.func
def random_rotation(state: wp.uint32):
    """Uniform unit quaternion (Shoemake)."""
    u = wp.randf(state)
    a = wp.randf(state, 0.0, 6.2831853)
    b = wp.randf(state, 0.0, 6.2831853)
    r = wp.sqrt(1.0 - u)
    s = wp.sqrt(u)
    return wp.quat(r * wp.sin(a), r * wp.cos(a), s * wp.sin(b), s * wp.cos(b))


@wp.func
def rotation_between(a: wp.vec3, b: wp.vec3):
    """Shortest rotation that takes unit vector a to unit vector b."""
    d = wp.dot(a, b)
    axis = wp.cross(a, b)
    q = wp.quat(axis[0], axis[1], axis[2], 1.0 + d)
    if d < -0.999999:
        t = tangent(a)
        q = wp.quat(t[0], t[1], t[2], 0.0)
    return wp.normalize(q)

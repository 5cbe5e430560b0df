"""Ferrari-Canny quality of a grasp."""

import warp as wp

from lgrasp.device.qp import vec6
from lgrasp.device.transforms import tangent

__all__ = ["epsilon_bound"]

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_STARTS = wp.constant(13)
_STEPS = wp.constant(40)


@wp.func
def _reach(
    u: vec6,
    arms: wp.array(dtype=wp.vec3),
    cones: wp.array(dtype=wp.vec3),
    k: wp.int32,
    scale: wp.float32,
    best: wp.array(dtype=wp.int32),
):
    """Largest u . w over the cone edges' wrenches; the contact edge that attains it goes to best[0]."""
    f = wp.vec3(u[0], u[1], u[2])
    t = wp.vec3(u[3], u[4], u[5]) * scale
    top = float(-1.0e30)
    for i in range(k):
        a = f + wp.cross(t, arms[i])
        for e in range(8):
            x = wp.dot(a, cones[i * 8 + e])
            if x > top:
                top = x
                best[0] = i * 8 + e
    return top


@wp.func
def epsilon_bound(
    arms: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    k: wp.int32,
    mu: wp.float32,
    radius: wp.float32,
    state: wp.uint32,
):
    """Ferrari-Canny epsilon (L1 hull of 8-edge cones with unit normal force, torque / radius), from above; >= 0.

    epsilon = min over unit wrenches u of max_i u . w_i. The inner maximum is convex in u, so subgradient descent on the
    sphere from several starts finds its least value; every iterate is an upper bound of epsilon.
    """
    cones = wp.zeros(shape=(48,), dtype=wp.vec3)
    for i in range(k):
        n = normals[i]
        t = tangent(n)
        b = wp.cross(n, t)
        for e in range(8):
            angle = 0.78539816 * float(e)
            cones[i * 8 + e] = n + (t * wp.cos(angle) + b * wp.sin(angle)) * mu
    best = wp.zeros(shape=(1,), dtype=wp.int32)
    scale = 1.0 / radius
    least = float(1.0e30)
    for s in range(_STARTS):
        u = vec6()
        if s < 12:
            u[s // 2] = 1.0 - 2.0 * float(s % 2)
        else:
            for c in range(6):
                u[c] = wp.randn(state)
            u = wp.normalize(u)
        step = float(0.3)
        for _t in range(_STEPS):
            top = _reach(u, arms, cones, k, scale, best)
            if top < least:
                least = top
            if top <= 0.0:
                return 0.0
            e = best[0]
            f = cones[e]
            m = wp.cross(arms[e // 8], f) * scale
            w = vec6(f[0], f[1], f[2], m[0], m[1], m[2])
            d = w - u * wp.dot(w, u)
            length = wp.length(d)
            if length < 1.0e-9:
                break
            u = wp.normalize(u - d * (step / length))
            step = step * 0.88
    return wp.max(least, 0.0)

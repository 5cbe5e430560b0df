"""Points on triangles, and the facets of a mesh about a point."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def closest_part(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3):
    """Point of triangle abc closest to p (Ericson, Real-Time Collision Detection, 5.1.5), and the corners that hold it.

    Returns:
        (x, y, z, sum of a: 1, b: 2, c: 4).
    """
    ab = b - a
    ac = c - a
    ap = p - a
    d1 = wp.dot(ab, ap)
    d2 = wp.dot(ac, ap)
    if d1 <= 0.0 and d2 <= 0.0:
        return wp.vec4(a[0], a[1], a[2], 1.0)
    bp = p - b
    d3 = wp.dot(ab, bp)
    d4 = wp.dot(ac, bp)
    if d3 >= 0.0 and d4 <= d3:
        return wp.vec4(b[0], b[1], b[2], 2.0)
    vc = d1 * d4 - d3 * d2
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0:
        x = a + ab * (d1 / (d1 - d3))
        return wp.vec4(x[0], x[1], x[2], 3.0)
    cp = p - c
    d5 = wp.dot(ab, cp)
    d6 = wp.dot(ac, cp)
    if d6 >= 0.0 and d5 <= d6:
        return wp.vec4(c[0], c[1], c[2], 4.0)
    vb = d5 * d2 - d1 * d6
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        x = a + ac * (d2 / (d2 - d6))
        return wp.vec4(x[0], x[1], x[2], 5.0)
    va = d3 * d6 - d5 * d4
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        x = b + (c - b) * ((d4 - d3) / ((d4 - d3) + (d5 - d6)))
        return wp.vec4(x[0], x[1], x[2], 6.0)
    s = 1.0 / (va + vb + vc)
    x = a + ab * (vb * s) + ac * (vc * s)
    return wp.vec4(x[0], x[1], x[2], 7.0)


@wp.func
def closest_on_triangle(a: wp.vec3, b: wp.vec3, c: wp.vec3, p: wp.vec3):
    """Point of triangle abc closest to p."""
    x = closest_part(a, b, c, p)
    return wp.vec3(x[0], x[1], x[2])


@wp.func
def least_facing(mesh: wp.uint64, p: wp.vec3, reach: wp.float32, n: wp.vec3):
    """Smallest cosine of n to the normals of the mesh's facets within ``reach`` [m] of p; 1 when there are none."""
    low = float(1.0)
    r = wp.vec3(reach, reach, reach)
    query = wp.mesh_query_aabb(mesh, p - r, p + r)
    face = int(0)
    while wp.mesh_query_aabb_next(query, face):
        a = wp.mesh_get_point(mesh, 3 * face)
        b = wp.mesh_get_point(mesh, 3 * face + 1)
        c = wp.mesh_get_point(mesh, 3 * face + 2)
        if wp.length(closest_on_triangle(a, b, c, p) - p) <= reach:
            low = wp.min(low, wp.dot(n, wp.mesh_eval_face_normal(mesh, face)))
    return low

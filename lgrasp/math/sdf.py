"""Signed distance grids: one lookup with trilinear interpolation, value or value and gradient."""

import warp as wp

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class Sdf:
    """A grid of signed distances [m], negative inside; x slowest, z fastest; several grids may share one array."""

    values: wp.array(dtype=wp.float32)
    first: wp.int32
    nx: wp.int32
    ny: wp.int32
    nz: wp.int32
    origin: wp.vec3
    inv_cell: wp.float32


@wp.func
def sdf_part(
    values: wp.array(dtype=wp.float32), first: wp.int32, shape: wp.vec3i, origin: wp.vec3, inv_cell: wp.float32
):
    """The grid that begins at place ``first`` of a shared array."""
    s = Sdf()
    s.values = values
    s.first = first
    s.nx = shape[0]
    s.ny = shape[1]
    s.nz = shape[2]
    s.origin = origin
    s.inv_cell = inv_cell
    return s


@wp.func
def sdf_value(s: Sdf, p: wp.vec3):
    """Signed distance at p [m]; beyond the grid a lower bound of the distance."""
    x = (p - s.origin) * s.inv_cell
    cx = wp.clamp(x[0], 0.0, float(s.nx) - 1.001)
    cy = wp.clamp(x[1], 0.0, float(s.ny) - 1.001)
    cz = wp.clamp(x[2], 0.0, float(s.nz) - 1.001)
    i = int(cx)
    j = int(cy)
    k = int(cz)
    fx = cx - float(i)
    fy = cy - float(j)
    fz = cz - float(k)
    a = s.first + (i * s.ny + j) * s.nz + k
    b = a + s.nz
    c = a + s.ny * s.nz
    d = c + s.nz
    v00 = s.values[a] + (s.values[a + 1] - s.values[a]) * fz
    v01 = s.values[b] + (s.values[b + 1] - s.values[b]) * fz
    v10 = s.values[c] + (s.values[c + 1] - s.values[c]) * fz
    v11 = s.values[d] + (s.values[d + 1] - s.values[d]) * fz
    v0 = v00 + (v01 - v00) * fy
    v1 = v10 + (v11 - v10) * fy
    v = v0 + (v1 - v0) * fx
    ox = x[0] - cx
    oy = x[1] - cy
    oz = x[2] - cz
    o2 = ox * ox + oy * oy + oz * oz
    if o2 > 0.0:
        # the surface is inside the grid, so it is no nearer than this
        o2 = o2 / (s.inv_cell * s.inv_cell)
        v = wp.sqrt(o2 + wp.max(v, 0.0) * wp.max(v, 0.0))
    return v


@wp.func
def sdf_gradient(s: Sdf, p: wp.vec3):
    """Unit gradient (3) and signed distance [m] at p, as a vec4 (gx, gy, gz, distance); p is clamped into the grid."""
    x = (p - s.origin) * s.inv_cell
    cx = wp.clamp(x[0], 0.0, float(s.nx) - 1.001)
    cy = wp.clamp(x[1], 0.0, float(s.ny) - 1.001)
    cz = wp.clamp(x[2], 0.0, float(s.nz) - 1.001)
    i = int(cx)
    j = int(cy)
    k = int(cz)
    fx = cx - float(i)
    fy = cy - float(j)
    fz = cz - float(k)
    a = s.first + (i * s.ny + j) * s.nz + k
    b = a + s.nz
    c = a + s.ny * s.nz
    d = c + s.nz
    d00 = s.values[a + 1] - s.values[a]
    d01 = s.values[b + 1] - s.values[b]
    d10 = s.values[c + 1] - s.values[c]
    d11 = s.values[d + 1] - s.values[d]
    v00 = s.values[a] + d00 * fz
    v01 = s.values[b] + d01 * fz
    v10 = s.values[c] + d10 * fz
    v11 = s.values[d] + d11 * fz
    v0 = v00 + (v01 - v00) * fy
    v1 = v10 + (v11 - v10) * fy
    v = v0 + (v1 - v0) * fx
    gx = v1 - v0
    gy = (v01 - v00) * (1.0 - fx) + (v11 - v10) * fx
    d0 = d00 + (d01 - d00) * fy
    d1 = d10 + (d11 - d10) * fy
    gz = d0 + (d1 - d0) * fx
    g = wp.vec3(gx, gy, gz)
    n = wp.length(g)
    if n > 1.0e-12:
        g = g / n
    ox = wp.vec3(x[0] - cx, x[1] - cy, x[2] - cz) / s.inv_cell
    o = wp.length(ox)
    if o > 0.0:
        # beyond the grid: the surface seen from the clamped point
        e = ox + g * v
        h = wp.length(e)
        return wp.vec4(e[0] / h, e[1] / h, e[2] / h, h)
    return wp.vec4(g[0], g[1], g[2], v)

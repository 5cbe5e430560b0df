"""Signed distance grids: one lookup with trilinear interpolation, value or value and gradient."""

import numpy as np
import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

BLOCK = wp.constant(4)
"""Cells on a side of the blocks whose least value is known."""

_NODE_REACH = wp.constant(2.0)  # cells: within half a cell along each axis of a node distances are less by this at most


@wp.struct
class Sdf:
    """A grid of signed distances [m], negative inside; x slowest, z fastest; several grids may share one array."""

    values: wp.array(dtype=wp.float32)  # (cells of all grids,) [m]
    first: wp.int32
    nx: wp.int32
    ny: wp.int32
    nz: wp.int32
    origin: wp.vec3
    inv_cell: wp.float32
    least: wp.array(dtype=wp.float32)  # (blocks,) least value in each block of BLOCK cells a side [m], or (0,)


def block_minima(values: np.ndarray) -> np.ndarray:
    """Least value in each block of BLOCK cells a side of a grid (nx, ny, nz), flat."""
    for axis, nodes in enumerate(values.shape):
        first = np.arange(0, nodes - 1, BLOCK)
        at = np.minimum(first[:, None] + np.arange(BLOCK + 1), nodes - 1)
        values = np.take(values, at, axis).min(axis + 1)
    return values.ravel()


@wp.struct
class Grids:
    """Distance grids [m] that share one array."""

    first: wp.array(dtype=wp.int32)  # (n,) or more, place of each in ``values``
    shape: wp.array(dtype=wp.vec3i)  # (n,)
    origin: wp.array(dtype=wp.vec3)  # (n,) [m]
    inv_cell: wp.array(dtype=wp.float32)  # (n,) [1/m]
    values: wp.array(dtype=wp.float32)  # (cells of all grids,) [m]


@wp.func
def sdf_of(g: Grids, i: wp.int32):
    """Grid i of several."""
    s = Sdf()
    s.values = g.values
    s.first = g.first[i]
    shape = g.shape[i]
    s.nx = shape[0]
    s.ny = shape[1]
    s.nz = shape[2]
    s.origin = g.origin[i]
    s.inv_cell = g.inv_cell[i]
    return s


@wp.func
def _clamped(s: Sdf, x: wp.vec3):
    """Grid coordinates x, moved into the grid."""
    return wp.vec3(
        wp.clamp(x[0], 0.0, float(s.nx) - 1.001),
        wp.clamp(x[1], 0.0, float(s.ny) - 1.001),
        wp.clamp(x[2], 0.0, float(s.nz) - 1.001),
    )


@wp.func
def beyond(x: wp.vec3, c: wp.vec3):
    """x - c, how far grid coordinates x are beyond the grid whose nearest point is c: exactly 0 within it.

    Equal coordinates are compared, as a compiler may round product and difference at once: x - c is not 0 then.
    """
    return wp.vec3(
        wp.where(x[0] == c[0], 0.0, x[0] - c[0]),
        wp.where(x[1] == c[1], 0.0, x[1] - c[1]),
        wp.where(x[2] == c[2], 0.0, x[2] - c[2]),
    )


@wp.func
def _edges(s: Sdf, c: wp.vec3):
    """Of the cell at grid coordinates c: values on its four edges along z at c's height, their rises [m], and where in
    the cell c lies.

    Edges by (x, y): (0, 0), (0, 1), (1, 0), (1, 1).
    """
    i = int(c[0])
    j = int(c[1])
    k = int(c[2])
    a = s.first + (i * s.ny + j) * s.nz + k
    b = a + s.nz
    e = a + s.ny * s.nz
    d = e + s.nz
    low = wp.vec4(s.values[a], s.values[b], s.values[e], s.values[d])
    high = wp.vec4(s.values[a + 1], s.values[b + 1], s.values[e + 1], s.values[d + 1])
    rise = high - low
    f = wp.vec3(c[0] - float(i), c[1] - float(j), c[2] - float(k))
    return low + rise * f[2], rise, f


@wp.func
def _along_y(v: wp.vec4, y: wp.float32):
    """Values of four edges, interpolated along y: at x = 0 and 1."""
    return wp.vec2(v[0] + (v[1] - v[0]) * y, v[2] + (v[3] - v[2]) * y)


@wp.func
def sdf_value(s: Sdf, p: wp.vec3):
    """Signed distance at p [m]; beyond the grid a lower bound of the distance."""
    x = (p - s.origin) * s.inv_cell
    c = _clamped(s, x)
    v, _rise, f = _edges(s, c)
    ends = _along_y(v, f[1])
    d = ends[0] + (ends[1] - ends[0]) * f[0]
    o = beyond(x, c)
    o2 = o[0] * o[0] + o[1] * o[1] + o[2] * o[2]
    if o2 > 0.0:
        # the surface is inside the grid, so it is no nearer than this
        o2 = o2 / (s.inv_cell * s.inv_cell)
        d = wp.sqrt(o2 + wp.max(d, 0.0) * wp.max(d, 0.0))
    return d


@wp.func
def sdf_far(s: Sdf, p: wp.vec3, limit: wp.float32):
    """True only if :func:`sdf_value` is ``limit`` [m] at least: by what a block of cells, or a node, tells at once."""
    c = _clamped(s, (p - s.origin) * s.inv_cell)
    if s.least.shape[0] > 0:
        ny = (s.ny + BLOCK - 2) // BLOCK
        nz = (s.nz + BLOCK - 2) // BLOCK
        return s.least[((int(c[0]) // BLOCK) * ny + int(c[1]) // BLOCK) * nz + int(c[2]) // BLOCK] >= limit
    node = (int(c[0] + 0.5) * s.ny + int(c[1] + 0.5)) * s.nz + int(c[2] + 0.5)
    return s.values[s.first + node] >= limit + _NODE_REACH / s.inv_cell


@wp.func
def sdf_below(s: Sdf, p: wp.vec3, limit: wp.float32):
    """True if :func:`sdf_value` is less than ``limit`` [m]."""
    if sdf_far(s, p, limit):
        return False
    return sdf_value(s, p) < limit


@wp.func
def nearer(s: Sdf, p: wp.vec3, least: wp.float32):
    """The smaller of ``least`` and the signed distance at p [m]."""
    if sdf_far(s, p, least):
        return least
    return wp.min(least, sdf_value(s, p))


@wp.func
def deeper(s: Sdf, p: wp.vec3, depth: wp.float32):
    """The larger of ``depth`` and the depth of p [m]."""
    if sdf_far(s, p, -depth):
        return depth
    return wp.max(depth, -sdf_value(s, p))


@wp.func
def sdf_gradient(s: Sdf, p: wp.vec3):
    """Unit gradient (3) and signed distance [m] at p, as a vec4 (gx, gy, gz, distance); p is clamped into the grid."""
    x = (p - s.origin) * s.inv_cell
    c = _clamped(s, x)
    v, rise, f = _edges(s, c)
    ends = _along_y(v, f[1])
    d = ends[0] + (ends[1] - ends[0]) * f[0]
    r = _along_y(rise, f[1])
    by_y = (v[1] - v[0]) * (1.0 - f[0]) + (v[3] - v[2]) * f[0]
    g = wp.vec3(ends[1] - ends[0], by_y, r[0] + (r[1] - r[0]) * f[0])
    n = wp.length(g)
    if n > 1.0e-12:
        g = g / n
    o = beyond(x, c) / s.inv_cell
    if wp.length(o) > 0.0:
        # beyond the grid: the surface seen from the clamped point
        e = o + g * d
        h = wp.length(e)
        return wp.vec4(e[0] / h, e[1] / h, e[2] / h, h)
    return wp.vec4(g[0], g[1], g[2], d)

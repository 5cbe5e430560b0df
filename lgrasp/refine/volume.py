"""What hands are drawn to and kept out of, on a device: distances with smooth normals, and how these turn."""

from dataclasses import dataclass

import numpy as np
import warp as wp

from lgrasp.geometry.clusters import evenly
from lgrasp.math.sdf import beyond
from lgrasp.object.model import ObjectModel
from lgrasp.runtime.device import KERNEL_OPTIONS, start
from lgrasp.runtime.structs import upload_struct

wp.set_module_options(KERNEL_OPTIONS)

_CLOUD_POINTS = 512  # of an object


@wp.struct
class Volume:
    """Slope (3) and value [m] of a distance grid at its nodes, x slowest, z fastest."""

    nodes: wp.array(dtype=wp.vec4)  # (nx ny nz,)
    nx: wp.int32
    ny: wp.int32
    nz: wp.int32
    origin: wp.vec3
    cell: wp.float32


@dataclass(frozen=True)
class TargetArrays:
    """An object, perhaps among others, on one device, in the object's internal frame."""

    own: "Volume"
    around: "Volume"
    has_around: bool
    cloud: wp.array
    """Points of the surface of all that the hand is kept out of [m], (n,) vec3."""
    com: wp.vec3
    radius: float
    device: str


def upload_target(model: ObjectModel, around: ObjectModel | None, device: str) -> TargetArrays:
    """Copy a target to a device."""
    start()
    own = _volume(model, device)
    solids = [model] if around is None else [model, around]
    cloud = np.concatenate([solid_cloud(m) for m in solids]).astype(np.float32)
    return TargetArrays(
        own=own,
        around=own if around is None else _volume(around, device),
        has_around=around is not None,
        cloud=wp.array(cloud, dtype=wp.vec3, device=device),
        com=wp.vec3(*map(float, model.com)),
        radius=model.radius,
        device=device,
    )


def solid_cloud(model: ObjectModel) -> np.ndarray:
    """Some points of an object's surface, evenly spread [m], (n, 3)."""
    return evenly(model.obstacle_points, min(_CLOUD_POINTS, len(model.obstacle_points)))


def _volume(model: ObjectModel, device: str) -> "Volume":
    slopes = np.gradient(model.sdf, float(model.sdf_cell))
    nodes = np.stack([*slopes, model.sdf], -1).reshape(-1, 4)
    shape = dict(zip(("nx", "ny", "nz"), map(int, model.sdf.shape), strict=True))
    return upload_struct(
        Volume, device, {"nodes": nodes, "origin": model.sdf_origin, "cell": float(model.sdf_cell), **shape}
    )


@wp.struct
class _Cell:
    """Where a point lies: the first of its eight nodes, its share of the cell, and how far beyond the grid it is."""

    first: wp.int32
    share: wp.vec3
    beyond: wp.vec3  # [m]


@wp.func
def _cell_of(v: Volume, p: wp.vec3):
    x = (p - v.origin) / v.cell
    c = wp.vec3(
        wp.clamp(x[0], 0.0, float(v.nx - 1)), wp.clamp(x[1], 0.0, float(v.ny - 1)), wp.clamp(x[2], 0.0, float(v.nz - 1))
    )
    i = wp.min(int(c[0]), v.nx - 2)
    j = wp.min(int(c[1]), v.ny - 2)
    k = wp.min(int(c[2]), v.nz - 2)
    s = _Cell()
    s.first = (i * v.ny + j) * v.nz + k
    s.share = wp.vec3(c[0] - float(i), c[1] - float(j), c[2] - float(k))
    s.beyond = beyond(x, c) * v.cell
    return s


@wp.func
def _along(a: wp.vec4, b: wp.vec4, f: wp.float32):
    return a + (b - a) * f


@wp.func
def volume_at(v: Volume, p: wp.vec3):
    """Outward unit normal (3) and signed distance [m] at p: p minus distance times normal is p's match."""
    s = _cell_of(v, p)
    a = s.first
    b = a + v.nz
    c = a + v.ny * v.nz
    d = c + v.nz
    fz = s.share[2]
    v0 = _along(_along(v.nodes[a], v.nodes[a + 1], fz), _along(v.nodes[b], v.nodes[b + 1], fz), s.share[1])
    v1 = _along(_along(v.nodes[c], v.nodes[c + 1], fz), _along(v.nodes[d], v.nodes[d + 1], fz), s.share[1])
    m = _along(v0, v1, s.share[0])
    n = wp.vec3(m[0], m[1], m[2])
    n = n / wp.max(wp.length(n), 1.0e-9)
    distance = m[3]
    if wp.length_sq(s.beyond) > 0.0:
        # beyond the grid: from the surface as seen from the nearest point of the grid
        way = s.beyond + n * wp.max(distance, 0.0)
        distance = wp.max(wp.length(way), 1.0e-9)
        n = way / distance
    return wp.vec4(n[0], n[1], n[2], distance)


@wp.struct
class Normal:
    """An outward unit normal and its derivatives by x, y and z of the point [1/m]."""

    n: wp.vec3
    by_x: wp.vec3
    by_y: wp.vec3
    by_z: wp.vec3


@wp.func
def turning_normal(v: Volume, p: wp.vec3):
    """Outward unit normal at p and its derivatives."""
    s = _cell_of(v, p)
    a = s.first
    b = a + v.nz
    c = a + v.ny * v.nz
    d = c + v.nz
    fx = s.share[0]
    fy = s.share[1]
    fz = s.share[2]
    da = v.nodes[a + 1] - v.nodes[a]
    db = v.nodes[b + 1] - v.nodes[b]
    dc = v.nodes[c + 1] - v.nodes[c]
    dd = v.nodes[d + 1] - v.nodes[d]
    va = v.nodes[a] + da * fz
    vb = v.nodes[b] + db * fz
    vc = v.nodes[c] + dc * fz
    vd = v.nodes[d] + dd * fz
    v0 = _along(va, vb, fy)
    v1 = _along(vc, vd, fy)
    m = _along(v0, v1, fx)
    slope_x = (v1 - v0) / v.cell
    slope_y = _along(vb - va, vd - vc, fx) / v.cell
    slope_z = _along(_along(da, db, fy), _along(dc, dd, fy), fx) / v.cell
    w = wp.vec3(m[0], m[1], m[2])
    length = wp.max(wp.length(w), 1.0e-9)
    n = w / length
    nx = _turned(n, wp.vec3(slope_x[0], slope_x[1], slope_x[2]), length)
    ny = _turned(n, wp.vec3(slope_y[0], slope_y[1], slope_y[2]), length)
    nz = _turned(n, wp.vec3(slope_z[0], slope_z[1], slope_z[2]), length)
    e = s.beyond
    if wp.length_sq(e) > 0.0:
        # beyond the grid: away from the surface as seen from the nearest point of the grid
        wx = _beyond(e[0], wp.vec3(1.0, 0.0, 0.0), nx * m[3] + n * slope_x[3])
        wy = _beyond(e[1], wp.vec3(0.0, 1.0, 0.0), ny * m[3] + n * slope_y[3])
        wz = _beyond(e[2], wp.vec3(0.0, 0.0, 1.0), nz * m[3] + n * slope_z[3])
        w = e + n * m[3]
        length = wp.max(wp.length(w), 1.0e-9)
        n = w / length
        nx = _turned(n, wx, length)
        ny = _turned(n, wy, length)
        nz = _turned(n, wz, length)
    out = Normal()
    out.n = n
    out.by_x = nx
    out.by_y = ny
    out.by_z = nz
    return out


@wp.func
def _turned(n: wp.vec3, slope: wp.vec3, length: wp.float32):
    """Derivative of w / |w| = n from that of w."""
    return (slope - n * wp.dot(n, slope)) / length


@wp.func
def _beyond(e: wp.float32, axis: wp.vec3, inside: wp.vec3):
    """Derivative along one axis: of the way out if the point is beyond the grid along it, of what is inside else."""
    if e != 0.0:
        return axis
    return inside

"""Warp kernels of objects; host functions live in ``sdf.py``, ``surface.py`` and ``regions.py``."""

import warp as wp

from lgrasp.math.triangles import closest_on_triangle
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.config.log_level = wp.LOG_ERROR
wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def draw_opposite(
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    cosine: float,
    seed: int,
    opposite_out: wp.array(dtype=wp.int32),
):
    """One of the points that face point i: both outward normals within the cone of the line between the two.

    Args:
        points: surface points [m], (n,).
        normals: outward unit normals, (n,).
        opposite_out: index of a point, -1 where none faces it, (n,).
    """
    i = wp.tid()
    state = wp.rand_init(seed, i)
    chosen = int(-1)
    found = int(0)
    for j in range(points.shape[0]):
        line = points[j] - points[i]
        limit = cosine * wp.length(line)
        if j != i and wp.dot(line, normals[j]) > limit and -wp.dot(line, normals[i]) > limit:
            found += 1
            if wp.randf(state) * float(found) < 1.0:
                chosen = j
    opposite_out[i] = chosen


@wp.kernel
def nearest_face_band(
    corners: wp.array2d(dtype=wp.vec3),
    origin: wp.vec3,
    cell: float,
    dims: wp.vec3i,
    band: float,
    key_out: wp.array(dtype=wp.uint64),
):
    """Every triangle offers itself to the cells within ``band`` of it; a cell keeps the smallest (distance², face).

    Args:
        corners: corners of every face [m], (f, 3).
        key_out: bits of distance² over the face, one a cell, (cells,).
    """
    f = wp.tid()
    a = corners[f, 0]
    b = corners[f, 1]
    c = corners[f, 2]
    lo = (wp.min(wp.min(a, b), c) - origin) / cell
    hi = (wp.max(wp.max(a, b), c) - origin) / cell
    reach = band / cell
    i0 = wp.max(int(wp.ceil(lo[0] - reach)), 0)
    j0 = wp.max(int(wp.ceil(lo[1] - reach)), 0)
    k0 = wp.max(int(wp.ceil(lo[2] - reach)), 0)
    i1 = wp.min(int(wp.floor(hi[0] + reach)), dims[0] - 1)
    j1 = wp.min(int(wp.floor(hi[1] + reach)), dims[1] - 1)
    k1 = wp.min(int(wp.floor(hi[2] + reach)), dims[2] - 1)
    n = wp.normalize(wp.cross(b - a, c - a))  # zero for a degenerate face: the plane test below then never rejects
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            for k in range(k0, k1 + 1):
                p = origin + cell * wp.vec3(float(i), float(j), float(k))
                if wp.abs(wp.dot(n, p - a)) <= band:
                    d = p - closest_on_triangle(a, b, c, p)
                    d2 = wp.dot(d, d)
                    if d2 <= band * band:
                        key = (wp.uint64(wp.cast(d2, wp.uint32)) << wp.uint64(32)) | wp.uint64(f)
                        at = (i * dims[1] + j) * dims[2] + k
                        if key < key_out[at]:
                            wp.atomic_min(key_out, at, key)


@wp.func
def left_of(u: wp.vec3d, v: wp.vec3d, iu: int, iv: int, x: wp.float64, y: wp.float64):
    """Side of the column (x, y) of the edge u-v seen along z; the two faces of an edge always get opposite answers."""
    if iu < iv:
        return (v[0] - u[0]) * (y - u[1]) - (v[1] - u[1]) * (x - u[0]) >= wp.float64(0.0)
    return (u[0] - v[0]) * (y - v[1]) - (u[1] - v[1]) * (x - v[0]) < wp.float64(0.0)


@wp.kernel
def lattice_crossings(
    vertices: wp.array(dtype=wp.vec3d),
    faces: wp.array2d(dtype=wp.int32),
    origin: wp.vec3d,
    cell: wp.float64,
    dims: wp.vec3i,
    step_out: wp.array3d(dtype=wp.int32),
):
    """Steps of the winding number along every z column of cells: +1 where it enters the object, -1 where it leaves.

    Args:
        vertices: [m], (v,).
        faces: (f, 3).
        step_out: (nx, ny, nz), zero before.
    """
    f = wp.tid()
    ia = faces[f, 0]
    ib = faces[f, 1]
    ic = faces[f, 2]
    a = vertices[ia]
    b = vertices[ib]
    c = vertices[ic]
    lo = (wp.min(wp.min(a, b), c) - origin) / cell
    hi = (wp.max(wp.max(a, b), c) - origin) / cell
    i0 = wp.max(int(wp.floor(lo[0])), 0)
    j0 = wp.max(int(wp.floor(lo[1])), 0)
    i1 = wp.min(int(wp.ceil(hi[0])), dims[0] - 1)
    j1 = wp.min(int(wp.ceil(hi[1])), dims[1] - 1)
    n = wp.cross(b - a, c - a)
    for i in range(i0, i1 + 1):
        x = origin[0] + cell * wp.float64(i)
        for j in range(j0, j1 + 1):
            y = origin[1] + cell * wp.float64(j)
            ab = left_of(a, b, ia, ib, x, y)
            bc = left_of(b, c, ib, ic, x, y)
            ca = left_of(c, a, ic, ia, x, y)
            if ab == bc and bc == ca and n[2] != wp.float64(0.0):
                z = a[2] - (n[0] * (x - a[0]) + n[1] * (y - a[1])) / n[2]
                z = wp.clamp(z, wp.min(wp.min(a[2], b[2]), c[2]), wp.max(wp.max(a[2], b[2]), c[2]))
                k = wp.max(int(wp.ceil((z - origin[2]) / cell)), 0)
                if k < dims[2]:
                    wp.atomic_add(step_out, i, j, k, wp.where(ab, -1, 1))


@wp.func
def node_of(at: int, dims: wp.vec3i):
    """Place in the grid of the cell with flat index ``at``."""
    return wp.vec3i(at / (dims[2] * dims[1]), (at / dims[2]) % dims[1], at % dims[2])


@wp.kernel
def winding_sign(
    mesh: wp.uint64,
    band_cells: wp.array(dtype=wp.int32),
    origin: wp.vec3,
    cell: float,
    dims: wp.vec3i,
    reach: float,
    inside_out: wp.array(dtype=wp.int32),
):
    """1 where the generalised winding number of an open mesh says inside, at the given cells only.

    Args:
        band_cells: flat index of each cell, (n,).
        inside_out: (n,).
    """
    t = wp.tid()
    at = band_cells[t]
    node = node_of(at, dims)
    p = origin + cell * wp.vec3(float(node[0]), float(node[1]), float(node[2]))
    hit = wp.mesh_query_point_sign_winding_number(mesh, p, reach, 2.0, 0.5)
    inside_out[t] = wp.where(hit.result and hit.sign < 0.0, 1, 0)


@wp.kernel
def far_distance(
    corners: wp.array2d(dtype=wp.vec3),
    nearest_face: wp.array(dtype=wp.int32),
    origin: wp.vec3,
    cell: float,
    dims: wp.vec3i,
    exact: float,
    distance_out: wp.array(dtype=float),
):
    """Unsigned distance of every cell to the nearest of the faces that it and its six neighbours were handed.

    Args:
        corners: corners of every face [m], (f, 3).
        nearest_face: face that each cell was handed, (cells,).
        distance_out: [m], (cells,).
    """
    at = wp.tid()
    node = node_of(at, dims)
    p = origin + cell * wp.vec3(float(node[0]), float(node[1]), float(node[2]))
    f = nearest_face[at]
    best = wp.length_sq(p - closest_on_triangle(corners[f, 0], corners[f, 1], corners[f, 2], p))
    if best > exact * exact:  # band cells know their face already
        for s in range(6):
            axis = s / 2
            step = wp.vec3i(0, 0, 0)
            step[axis] = 2 * (s % 2) - 1
            m = node + step
            if m[axis] >= 0 and m[axis] < dims[axis]:
                g = nearest_face[(m[0] * dims[1] + m[1]) * dims[2] + m[2]]
                if g != f:
                    q = closest_on_triangle(corners[g, 0], corners[g, 1], corners[g, 2], p)
                    best = wp.min(best, wp.length_sq(p - q))
    distance_out[at] = wp.sqrt(best)


@wp.kernel
def fold_spread(
    corners: wp.array2d(dtype=wp.vec3),
    neighbours: wp.array2d(dtype=wp.int32),
    points: wp.array(dtype=wp.vec3),
    normals: wp.array(dtype=wp.vec3),
    point_face: wp.array(dtype=wp.int32),
    radius: float,
    queue: wp.array2d(dtype=wp.int32),
    dot_out: wp.array(dtype=float),
):
    """Smallest dot product of a point's normal with the faces reached over the surface within ``radius``.

    Walks breadth-first over edge neighbours (``queue`` holds the visited faces of a point, its width bounds the walk),
    so the far side of a thin wall does not count. An open edge within the radius gives -1.

    Args:
        corners: corners of every face [m], (f, 3).
        neighbours: face across each edge, -1 for none, (f, 3).
        points: [m], (n,).
        normals: outward unit normals, (n,).
        point_face: face that each point lies on, (n,).
        queue: scratch, (n, most faces of a walk).
        dot_out: (n,).
    """
    t = wp.tid()
    p = points[t]
    n = normals[t]
    queue[t, 0] = point_face[t]
    head = wp.int32(0)
    tail = wp.int32(1)
    worst = wp.float32(1.0)
    while head < tail:
        f = queue[t, head]
        head += 1
        for e in range(3):
            g = neighbours[f, e]
            if g < 0:
                u = corners[f, e]
                v = corners[f, (e + 1) % 3]
                if wp.length(p - closest_on_triangle(u, v, v, p)) <= radius:
                    worst = -1.0
            else:
                seen = wp.int32(0)
                for s in range(tail):
                    if queue[t, s] == g:
                        seen = 1
                if seen == 0 and tail < queue.shape[1]:
                    a = corners[g, 0]
                    b = corners[g, 1]
                    c = corners[g, 2]
                    if wp.length(p - closest_on_triangle(a, b, c, p)) <= radius:
                        queue[t, tail] = g
                        tail += 1
                        m = wp.cross(b - a, c - a)
                        if wp.length(m) > 0.0:
                            worst = wp.min(worst, wp.dot(n, wp.normalize(m)))
    dot_out[t] = worst


@wp.kernel
def locate_points(
    mesh: wp.uint64,
    points: wp.array(dtype=wp.vec3),
    reach: float,
    face_out: wp.array(dtype=wp.int32),
    corner_out: wp.array(dtype=wp.vec3),
    inside_out: wp.array(dtype=wp.int32),
):
    """Nearest face of each point, and whether the winding number says that the point is inside.

    Args:
        points: [m], (n,).
        face_out: (n,).
        corner_out: barycentric coordinates of the nearest place, by corner, (n,).
        inside_out: 1 or 0, (n,).
    """
    i = wp.tid()
    hit = wp.mesh_query_point_sign_winding_number(mesh, points[i], reach, 2.0, 0.5)
    face_out[i] = hit.face
    corner_out[i] = wp.vec3(hit.u, hit.v, 1.0 - hit.u - hit.v)
    inside_out[i] = wp.where(hit.sign < 0.0, 1, 0)

"""Kernel of the depth camera: normals from a depth image."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def fit_normals(
    point: wp.array3d(dtype=wp.vec3),
    window: wp.int32,
    step: wp.float32,
    # out
    normal_out: wp.array3d(dtype=wp.vec3),
):
    """One thread per (view, row, column): normal of the plane through the pixels around, turned to the camera.

    Of the window only points count whose depth differs by less than ``step`` times the depth per pixel in between. Zero
    where fewer than six do, or where they lie on a line.

    Args:
        point: camera frame [m], zero where nothing was seen, (V, rows, columns).
        normal_out: camera frame, (V, rows, columns).
    """
    v, i, j = wp.tid()
    p = point[v, i, j]
    normal_out[v, i, j] = wp.vec3(0.0)
    if p[2] <= 0.0:
        return
    rows = point.shape[1]
    columns = point.shape[2]
    count = float(0.0)
    total = wp.vec3(0.0)
    spread = wp.mat33(0.0)
    for a in range(wp.max(i - window, 0), wp.min(i + window + 1, rows)):
        for b in range(wp.max(j - window, 0), wp.min(j + window + 1, columns)):
            near = point[v, a, b] - p
            apart = float(wp.max(wp.abs(a - i), wp.abs(b - j)))
            if point[v, a, b][2] > 0.0 and wp.abs(near[2]) <= step * p[2] * wp.max(apart, 1.0):
                count = count + 1.0
                total = total + near
                spread = spread + wp.outer(near, near)
    if count < 6.0:
        return
    spread = spread - wp.outer(total, total) / count
    largest = wp.trace(spread)
    if largest <= 0.0:
        return
    axes, sizes = wp.eig3(spread / largest)
    least = int(0)
    for k in range(1, 3):
        if sizes[k] < sizes[least]:
            least = k
    middle = 1.0 - sizes[least] - wp.max(sizes)
    if middle < 1.0e-3:
        return
    n = wp.normalize(wp.vec3(axes[0, least], axes[1, least], axes[2, least]))
    if wp.dot(n, p) > 0.0:
        n = -n
    normal_out[v, i, j] = n

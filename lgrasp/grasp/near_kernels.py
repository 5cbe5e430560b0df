"""Kernel that finds near-duplicates with a hash grid over object positions."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.func
def _is_near(
    position: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.vec4),
    q: wp.array2d(dtype=wp.float32),
    a: wp.int32,
    b: wp.int32,
    reach: wp.float32,
    cosine: wp.float32,
    joint: wp.float32,
):
    d = position[a] - position[b]
    if wp.dot(d, d) > reach * reach or wp.abs(wp.dot(rotation[a], rotation[b])) < cosine:
        return False
    same = bool(True)
    for k in range(q.shape[1]):
        if wp.abs(q[a, k] - q[b, k]) > joint:
            same = False
            break
    return same


@wp.kernel
def list_near(
    grid: wp.uint64,
    position: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.vec4),
    q: wp.array2d(dtype=wp.float32),
    rows: wp.array(dtype=wp.int32),
    reach: wp.float32,
    cosine: wp.float32,
    joint: wp.float32,
    first: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    near_out: wp.array(dtype=wp.int32),
):
    """Rows near each of some rows and before it: counted, and written from place ``first`` on (empty: counted only)."""
    i = wp.tid()
    row = rows[i]
    n = int(0)
    query = wp.hash_grid_query(grid, position[row], reach)
    other = int(0)
    while wp.hash_grid_query_next(query, other):
        if other < row and _is_near(position, rotation, q, row, other, reach, cosine, joint):
            if first.shape[0] > 0:
                near_out[first[i] + n] = other
            n += 1
    count_out[i] = n

"""Kernel that finds near-duplicates with a hash grid over object positions."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.struct
class Near:
    """N rows, and how near duplicates are."""

    position: wp.array(dtype=wp.vec3)  # (N,) [m]
    rotation: wp.array(dtype=wp.vec4)  # (N,) quaternion
    q: wp.array2d(dtype=wp.float32)  # (N, K) [rad or m]
    reach: wp.float32  # [m]
    cosine: wp.float32  # least, of half the angle
    joint: wp.float32  # [rad or m]


@wp.func
def _is_near(x: Near, a: wp.int32, b: wp.int32):
    d = x.position[a] - x.position[b]
    if wp.dot(d, d) > x.reach * x.reach or wp.abs(wp.dot(x.rotation[a], x.rotation[b])) < x.cosine:
        return False
    same = bool(True)
    for k in range(x.q.shape[1]):
        if wp.abs(x.q[a, k] - x.q[b, k]) > x.joint:
            same = False
            break
    return same


@wp.kernel
def list_near(
    grid: wp.uint64,
    x: Near,
    rows: wp.array(dtype=wp.int32),
    first: wp.array(dtype=wp.int32),
    count_out: wp.array(dtype=wp.int32),
    near_out: wp.array(dtype=wp.int32),
):
    """Rows near each of some rows and before it: counted, and written from place ``first`` on (empty: counted only).

    Args:
        rows: the rows that are asked about, (n,).
        first: place of each one's list, (n,) or (0,).
        count_out: near rows of each, (n,).
        near_out: the lists, (all,).
    """
    i = wp.tid()
    row = rows[i]
    n = int(0)
    query = wp.hash_grid_query(grid, x.position[row], x.reach)
    other = int(0)
    while wp.hash_grid_query_next(query, other):
        if other < row and _is_near(x, row, other):
            if first.shape[0] > 0:
                near_out[first[i] + n] = other
            n += 1
    count_out[i] = n

"""Kernel that finds near-duplicates with a hash grid over object positions."""

import warp as wp

from lgrasp.device.runtime import KERNEL_OPTIONS

__all__ = ["near_earlier"]

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def near_earlier(
    grid: wp.uint64,
    position: wp.array(dtype=wp.vec3),
    rotation: wp.array(dtype=wp.vec4),
    q: wp.array2d(dtype=wp.float32),
    first: wp.int32,
    reach: wp.float32,
    cosine: wp.float32,
    joint: wp.float32,
    near_out: wp.array(dtype=wp.int32),
):
    """1 when a row before row first + i is within reach [m], half-angle cosine and joint [rad or m] of it, else 0."""
    i = wp.tid()
    row = first + i
    p = position[row]
    r = rotation[row]
    near = int(0)
    query = wp.hash_grid_query(grid, p, reach)
    other = int(0)
    while wp.hash_grid_query_next(query, other):
        if near == 0 and other < row:
            d = position[other] - p
            if wp.dot(d, d) <= reach * reach and wp.abs(wp.dot(r, rotation[other])) >= cosine:
                same = int(1)
                for k in range(q.shape[1]):
                    if wp.abs(q[row, k] - q[other, k]) > joint:
                        same = 0
                        break
                near = same
    near_out[i] = near

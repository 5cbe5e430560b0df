"""Which convex pieces of a hand touch."""

import warp as wp

from lgrasp.math.convex import Pieces, pieces_clear
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def mark_touching(
    pieces: Pieces,
    pose: wp.array2d(dtype=wp.transform),
    pairs: wp.array(dtype=wp.vec2i),
    margin: wp.float32,
    # out
    touch_out: wp.array2d(dtype=wp.int32),
):
    """Pairs of pieces that are within ``margin`` [m] of each other; launched over (posture, pair).

    Args:
        pose: T_base_body, (N, B).
        pairs: two pieces each, (Q,).
        touch_out: set to 1 where they are, (N, Q).
    """
    row, k = wp.tid()
    i = pairs[k][0]
    j = pairs[k][1]
    T = wp.transform_inverse(pose[row, pieces.body[i]]) * pose[row, pieces.body[j]]
    if not pieces_clear(pieces, i, j, T, margin):
        touch_out[row, k] = 1

"""Kernels of plans."""

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def invert_poses(pose: wp.array(dtype=wp.transform), pose_out: wp.array(dtype=wp.transform)):
    """``T^-1``; launched over poses.

    Args:
        pose: (N,).
        pose_out: (N,).
    """
    i = wp.tid()
    pose_out[i] = wp.transform_inverse(pose[i])

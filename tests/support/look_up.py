"""What kernels read in distance grids."""

import numpy as np
import warp as wp

from lgrasp.math.sdf import Sdf, block_minima, deeper, sdf_below, sdf_gradient, sdf_value
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


@wp.kernel
def read_grid(s: Sdf, p: wp.array(dtype=wp.vec3), value_out: wp.array(dtype=float), slope_out: wp.array(dtype=wp.vec4)):
    i = wp.tid()
    value_out[i] = sdf_value(s, p[i])
    slope_out[i] = sdf_gradient(s, p[i])


@wp.kernel
def read_limits(
    s: Sdf, p: wp.array(dtype=wp.vec3), limit: float, below_out: wp.array(dtype=int), deeper_out: wp.array(dtype=float)
):
    i = wp.tid()
    below_out[i] = int(sdf_below(s, p[i], limit))
    deeper_out[i] = deeper(s, p[i], limit)


def look_up(
    device: str, values: np.ndarray, origin: np.ndarray, cell: float, p: np.ndarray, first: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Values (n,) and (gradient, value) (n, 4) at points p; ``first`` numbers of another grid come before this one."""
    s, points = _grid(device, values, origin, cell, first), wp.array(p.astype(np.float32), dtype=wp.vec3, device=device)
    value, slope = (wp.empty(len(p), dtype=kind, device=device) for kind in (float, wp.vec4))
    wp.launch(read_grid, len(p), [s, points], [value, slope], device=device)
    return value.numpy(), slope.numpy()


def look_up_limits(
    device: str, values: np.ndarray, origin: np.ndarray, cell: float, p: np.ndarray, limit: float, *, blocks: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Whether values at points p are below a limit, and depths that are ``limit`` at least, (n,); ``blocks``: their
    least values are known."""
    s, points = _grid(device, values, origin, cell), wp.array(p.astype(np.float32), dtype=wp.vec3, device=device)
    if blocks:
        s.least = wp.array(block_minima(values), dtype=wp.float32, device=device)
    below, depth = (wp.empty(len(p), dtype=kind, device=device) for kind in (int, float))
    wp.launch(read_limits, len(p), [s, points, limit], [below, depth], device=device)
    return below.numpy() == 1, depth.numpy()


def _grid(device: str, values: np.ndarray, origin: np.ndarray, cell: float, first: int = 0) -> Sdf:
    s = Sdf()
    flat = np.concatenate([np.full(first, np.nan), values.ravel(), [np.nan]]).astype(np.float32)
    s.values, s.first = wp.array(flat, dtype=wp.float32, device=device), first
    s.nx, s.ny, s.nz = values.shape
    s.origin, s.inv_cell = wp.vec3(*np.asarray(origin).tolist()), 1 / cell
    return s

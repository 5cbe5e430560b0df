"""Linear systems of small symmetric matrices, in kernels."""

from typing import Any

import warp as wp

from lgrasp.math.limits import MAX_DOFS
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.unrolled import unrolled

wp.set_module_options(KERNEL_OPTIONS)


def solving(size: int) -> Any:
    """x with (A + shift I) x = b for the leading n x n block of symmetric A, by Cholesky, for matrices of one size.

    Squared pivots are ``floor`` at least; x is 0 beyond n.
    """
    square, column = wp.types.matrix((size, size), wp.float32), wp.types.vector(size, wp.float32)

    @unrolled
    @wp.func
    def solve(A: square, b: column, n: wp.int32, shift: wp.float32, floor: wp.float32):
        L = square()
        x = column()
        for i in range(wp.static(size)):
            if wp.static(i) < n:
                y = b[i]
                for j in range(i):
                    s = A[i, wp.static(j)]
                    for c in range(j):
                        s -= L[i, wp.static(c)] * L[j, c]
                    L[i, j] = s / L[j, j]
                d = A[i, i] + shift
                for c in range(i):
                    d -= L[i, wp.static(c)] * L[i, c]
                    y -= L[i, c] * x[c]
                L[i, i] = wp.sqrt(wp.max(d, floor))
                x[i] = y / L[i, i]
        for r in range(wp.static(size)):
            i = wp.static(size - 1 - r)
            if i < n:
                s = x[i]
                for c in range(wp.static(size - r), wp.static(size)):
                    s -= L[wp.static(c), i] * x[c]
                x[i] = s / L[i, i]
        return x

    return solve


mat_dof = wp.types.matrix((MAX_DOFS, MAX_DOFS), wp.float32)
solve_dofs = solving(MAX_DOFS)
"""For the joints of a group."""

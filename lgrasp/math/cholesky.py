"""Linear systems of small symmetric matrices, in kernels."""

from typing import Any

import warp as wp

from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)


def solving(size: int) -> Any:
    """x with (A + shift I) x = b for the leading n x n block of symmetric A, by Cholesky, for matrices of one size.

    Squared pivots are ``floor`` at least; x is 0 beyond n.
    """
    square, column = wp.types.matrix((size, size), wp.float32), wp.types.vector(size, wp.float32)

    @wp.func
    def solve(A: square, b: column, n: wp.int32, shift: wp.float32, floor: wp.float32):
        L = square()
        x = column()
        for i in range(n):
            for j in range(i + 1):
                s = A[i, j]
                if i == j:
                    s += shift
                for c in range(j):
                    s -= L[i, c] * L[j, c]
                if i == j:
                    L[i, i] = wp.sqrt(wp.max(s, floor))
                else:
                    L[i, j] = s / L[j, j]
        for i in range(n):
            s = b[i]
            for c in range(i):
                s -= L[i, c] * x[c]
            x[i] = s / L[i, i]
        for r in range(n):
            i = n - 1 - r
            s = x[i]
            for c in range(i + 1, n):
                s -= L[c, i] * x[c]
            x[i] = s / L[i, i]
        return x

    return solve

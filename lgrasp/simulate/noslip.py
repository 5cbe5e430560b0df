"""Friction that does not creep, for MuJoCo Warp: one block of threads a world.

After the solver, whose friction is soft, the friction of each elliptic contact is found again as if it were hard, with
all else as it is. For the friction f of a contact, which changes the accelerations a of J's rows by A = J M^-1 J^T,

    min  1/2 f^T A f + f^T (a - a_ref - A f_old),   |f / mu| <= normal force

one contact after the other, in some sweeps. This is MuJoCo's ``noslip``; that of MuJoCo Warp has one thread a world,
which takes as long as all the rest of a step.
"""

from functools import lru_cache
from typing import Any

import warp as wp

from lgrasp.math.lanes import LANES
from lgrasp.runtime.device import KERNEL_OPTIONS
from lgrasp.runtime.optional import import_mujoco
from lgrasp.runtime.structs import make_struct

wp.set_module_options(KERNEL_OPTIONS)

_LEAST = wp.constant(1.0e-10)
_NEWTON = wp.constant(12)  # iterations for the multiplier


@wp.struct
class _Inertia:
    """The inertia of every world, lower triangle in sparse rows; V degrees of freedom."""

    length: wp.array(dtype=wp.int32)  # (V,) of each row
    first: wp.array(dtype=wp.int32)  # (V,)
    column: wp.array(dtype=wp.int32)  # (Z,) what moves the row's joint, itself last
    value: wp.array2d(dtype=wp.float32)  # (W, Z)


@wp.struct
class _Rows:
    """Constraints of W worlds, at most R each, with sparse rows of their Jacobian."""

    elliptic: wp.int32  # the kind that contacts with friction have
    count: wp.array(dtype=wp.int32)  # (W,)
    kinds: wp.array2d(dtype=wp.int32)  # (W, R)
    contact: wp.array2d(dtype=wp.int32)  # (W, R)
    length: wp.array2d(dtype=wp.int32)  # (W, R)
    first: wp.array2d(dtype=wp.int32)  # (W, R)
    column: wp.array3d(dtype=wp.int32)  # (W, 1, ...)
    value: wp.array3d(dtype=wp.float32)  # (W, 1, ...)
    aim: wp.array2d(dtype=wp.float32)  # (W, R) accelerations that they ask for
    force: wp.array2d(dtype=wp.float32)  # (W, R)
    start: wp.array2d(dtype=wp.int32)  # (C, ...) first row of each contact, along its normal
    directions: wp.array(dtype=wp.int32)  # (C,) its rows
    friction: wp.array2d(dtype=wp.float32)  # (C, 5) coefficients


@wp.struct
class _Scratch:
    """What the rows of contacts do, filled up with zeros to V' columns."""

    factor: wp.array2d(dtype=wp.float32)  # (W, Z) of the inertia, L^T D L; D in the place of the ones
    jacobian: wp.array3d(dtype=wp.float32)  # (W, R, V')
    answer: wp.array3d(dtype=wp.float32)  # (W, R, V') accelerations that a unit force gives


@wp.func
def _solve(inertia: _Inertia, L: wp.array(dtype=wp.float32), x: wp.array(dtype=wp.float32)):
    """Turn forces x (V) into accelerations, in place."""
    n = inertia.first.shape[0]
    for back in range(n):
        i = n - 1 - back
        last = inertia.first[i] + inertia.length[i] - 1
        if x[i] != 0.0:
            for k in range(inertia.first[i], last):
                x[inertia.column[k]] = x[inertia.column[k]] - L[k] * x[i]
            x[i] = x[i] / L[last]
    for i in range(n):
        for k in range(inertia.first[i], inertia.first[i] + inertia.length[i] - 1):
            x[i] = x[i] - L[k] * x[inertia.column[k]]


@wp.kernel
def _factor(
    inertia: _Inertia,
    count: wp.array(dtype=wp.int32),
    smooth: wp.array2d(dtype=wp.float32),
    constraint: wp.array2d(dtype=wp.float32),
    scratch_out: _Scratch,
    acceleration_out: wp.array2d(dtype=wp.float32),
):
    """Factor the inertia of each world that has constraints; accelerations become those of the solver's forces.

    Args:
        count: (W,) constraints.
        smooth: (W, V) forces without constraints [N or N m].
        constraint: (W, V) those of constraints.
        acceleration_out: (W, V).
    """
    w = wp.tid()
    if count[w] > 0:
        L = scratch_out.factor[w]
        for k in range(L.shape[0]):
            L[k] = inertia.value[w, k]
        rows = inertia.first.shape[0]
        for back in range(rows):
            first = inertia.first[rows - 1 - back]
            last = first + inertia.length[rows - 1 - back] - 1
            for ahead in range(last - first):
                k = last - 1 - ahead
                share = L[k] / L[last]
                above = inertia.first[inertia.column[k]]
                for j in range(k - first + 1):
                    L[above + j] = L[above + j] - share * L[first + j]
                L[k] = share
        for i in range(rows):
            acceleration_out[w, i] = smooth[w, i] + constraint[w, i]
        _solve(inertia, L, acceleration_out[w])


@wp.func
def _cheapest(A: wp.mat33, b: wp.vec3, mu: wp.vec3, normal: wp.float32):
    """The f of least 1/2 f A f + f b within |f / mu| <= normal."""
    D = wp.diag(mu)
    S = D * A * D
    g = D * b
    x = wp.vec3(0.0)
    extra = float(0.0)
    for _it in range(_NEWTON):
        inverse = wp.inverse(S + wp.identity(n=3, dtype=wp.float32) * extra)
        x = -(inverse * g)
        far = wp.length(x)
        if far <= normal * 1.00001:
            break
        # the length falls with the multiplier nearly as 1 / (a + multiplier) does
        extra += (far / normal - 1.0) * far * far / wp.max(wp.dot(x, inverse * x), _LEAST)
    far = wp.length(x)
    if far > normal:
        x = x * (normal / far)
    return D * x


@lru_cache
def noslip_kernels(width: int) -> tuple[Any, Any]:
    """Two kernels for rows of ``width`` columns: what the rows do, and the sweeps."""

    @wp.kernel(module="unique", enable_backward=False)
    def fill(rows: _Rows, inertia: _Inertia, scratch_out: _Scratch):
        """Write the rows of friction and what they do; (W, R)."""
        w, r = wp.tid()
        if r >= rows.count[w] or rows.kinds[w, r] != rows.elliptic:
            return
        if rows.start[rows.contact[w, r], 0] == r:
            return
        x = wp.zeros(shape=(width,), dtype=wp.float32)
        for k in range(rows.first[w, r], rows.first[w, r] + rows.length[w, r]):
            x[rows.column[w, 0, k]] = rows.value[w, 0, k]
        for i in range(width):
            scratch_out.jacobian[w, r, i] = x[i]
        _solve(inertia, scratch_out.factor[w], x)
        for i in range(width):
            scratch_out.answer[w, r, i] = x[i]

    @wp.kernel(module="unique", enable_backward=False)
    def sweep(rows: _Rows, scratch: _Scratch, iterations: wp.int32, acceleration_out: wp.array2d(dtype=wp.float32)):
        """Find the friction of every contact of a world afresh; one block of threads a world.

        Args:
            acceleration_out: (W, V), changed accordingly.
        """
        w = wp.tid()
        end = wp.min(rows.count[w], rows.kinds.shape[1])
        a = wp.tile_load(acceleration_out[w], shape=width)
        for _it in range(iterations):
            r = int(0)
            while r < end:
                ahead = int(1)
                if rows.kinds[w, r] == rows.elliptic:
                    c = rows.contact[w, r]
                    ahead = rows.directions[c]
                    normal = rows.force[w, r]
                    if ahead >= 3 and r + ahead <= end and normal > 0.0:
                        last = wp.where(ahead > 3, r + 3, r + 2)
                        used = wp.where(ahead > 3, 1.0, 0.0)
                        j0 = wp.tile_load(scratch.jacobian[w, r + 1], shape=width)
                        j1 = wp.tile_load(scratch.jacobian[w, r + 2], shape=width)
                        j2 = wp.tile_load(scratch.jacobian[w, last], shape=width) * used
                        y0 = wp.tile_load(scratch.answer[w, r + 1], shape=width)
                        y1 = wp.tile_load(scratch.answer[w, r + 2], shape=width)
                        y2 = wp.tile_load(scratch.answer[w, last], shape=width) * used
                        A = wp.mat33()
                        A[0, 0] = wp.max(wp.tile_sum(wp.tile_map(wp.mul, j0, y0))[0], _LEAST)
                        A[1, 1] = wp.max(wp.tile_sum(wp.tile_map(wp.mul, j1, y1))[0], _LEAST)
                        A[2, 2] = wp.max(wp.tile_sum(wp.tile_map(wp.mul, j2, y2))[0], _LEAST) + (1.0 - used)
                        A[0, 1] = wp.tile_sum(wp.tile_map(wp.mul, j0, y1))[0]
                        A[0, 2] = wp.tile_sum(wp.tile_map(wp.mul, j0, y2))[0]
                        A[1, 2] = wp.tile_sum(wp.tile_map(wp.mul, j1, y2))[0]
                        A[1, 0] = A[0, 1]
                        A[2, 0] = A[0, 2]
                        A[2, 1] = A[1, 2]
                        rest = wp.vec3(
                            wp.tile_sum(wp.tile_map(wp.mul, j0, a))[0] - rows.aim[w, r + 1],
                            wp.tile_sum(wp.tile_map(wp.mul, j1, a))[0] - rows.aim[w, r + 2],
                            wp.tile_sum(wp.tile_map(wp.mul, j2, a))[0] - rows.aim[w, last] * used,
                        )
                        before = wp.vec3(rows.force[w, r + 1], rows.force[w, r + 2], rows.force[w, last] * used)
                        twist = wp.where(ahead > 3, rows.friction[c, 2], 1.0)
                        mu = wp.vec3(rows.friction[c, 0], rows.friction[c, 1], twist)
                        f = _cheapest(A, rest - A * before, mu, normal)
                        more = f - before
                        if wp.dot(more, 0.5 * (A * more) + rest) <= _LEAST:
                            rows.force[w, r + 1] = f[0]
                            rows.force[w, r + 2] = f[1]
                            if ahead > 3:
                                rows.force[w, last] = f[2]
                            a += y0 * more[0] + y1 * more[1] + y2 * more[2]
                r += ahead
        wp.tile_store(acceleration_out[w], a)

    return fill, sweep


class NoSlip:
    """Takes the creep out of friction, in place.

    Args:
        m, d: MuJoCo Warp's model and data: sparse Jacobian, elliptic cones, contacts of at most four directions.
        iterations: sweeps over all contacts.
    """

    def __init__(self, m: Any, d: Any, iterations: int) -> None:
        self._d, self._iterations = d, iterations
        worlds, room = d.nworld, d.njmax
        width = -(-m.nv // LANES) * LANES  # rows are filled up
        self._inertia = make_struct(_Inertia, length=m.M_rownnz, first=m.M_rowadr, column=m.M_colind, value=d.M)
        e, c = d.efc, d.contact
        friction = wp.array(ptr=c.friction.ptr, dtype=wp.float32, shape=(len(c.friction), 5), copy=False)
        self._rows = make_struct(
            _Rows,
            elliptic=int(import_mujoco().mjtConstraint.mjCNSTR_CONTACT_ELLIPTIC),
            count=d.nefc,
            kinds=e.type,
            contact=e.id,
            length=e.J_rownnz,
            first=e.J_rowadr,
            column=e.J_colind,
            value=e.J,
            aim=e.aref,
            force=e.force,
            start=c.efc_address,
            directions=c.dim,
            friction=friction,
        )
        self._scratch = make_struct(
            _Scratch,
            factor=wp.empty(d.M.shape, dtype=wp.float32),
            jacobian=wp.empty((worlds, room, width), dtype=wp.float32),
            answer=wp.empty((worlds, room, width), dtype=wp.float32),
        )
        self._fill, self._sweep = noslip_kernels(width)

    def run(self) -> None:
        """Change the friction that the solver found, and with it the accelerations ``qacc``."""
        d, scratch = self._d, self._scratch
        forces = [d.nefc, d.qfrc_smooth, d.qfrc_constraint]
        wp.launch(_factor, d.nworld, [self._inertia, *forces], [scratch, d.qacc])
        wp.launch(self._fill, (d.nworld, d.njmax), [self._rows, self._inertia], [scratch])
        inputs = [self._rows, scratch, self._iterations]
        wp.launch_tiled(self._sweep, dim=[d.nworld], inputs=inputs, outputs=[d.qacc], block_dim=LANES)

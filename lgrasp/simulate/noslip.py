"""Friction that does not creep, for MuJoCo Warp: one warp of a GPU a world.

After the solver, whose friction is soft, the friction of each elliptic contact is found again as if it were hard, with
all else as it is. For the friction f of a contact, which changes the accelerations a of J's rows by A = J M^-1 J^T,

    min  1/2 f^T A f + f^T (a - a_ref - A f_old),   |f / mu| <= normal force

one contact after the other, in some sweeps. This is MuJoCo's ``noslip``; that of MuJoCo Warp has one thread a world,
which takes as long as all the rest of a step.
"""

from typing import Any

import warp as wp

from lgrasp.math.lanes import LANES, lanes_of, lanes_sum, meet
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
    directions: wp.array(dtype=wp.int32)  # (C,) rows of each contact, the first along its normal
    friction: wp.array2d(dtype=wp.float32)  # (C, 5) coefficients


@wp.struct
class _Scratch:
    """What the rows of contacts do; of the last four a lane reads what it has written."""

    factor: wp.array2d(dtype=wp.float32)  # (W, Z) of the inertia, L^T D L; D in the place of the ones
    inverse: wp.array3d(dtype=wp.float32)  # (W, V, V) of the inertia
    jacobian: wp.array3d(dtype=wp.float32)  # (W, R, V)
    answer: wp.array3d(dtype=wp.float32)  # (W, R, V) accelerations that a unit force gives
    block: wp.array2d(dtype=wp.mat33)  # (W, R) A of the contact that begins with this row


@wp.func
def _factor(inertia: _Inertia, w: wp.int32, lane: wp.int32, lanes: wp.int32, L: wp.array(dtype=wp.float32)):
    """Factor the inertia of a world."""
    for k in range(lane, L.shape[0], lanes):
        L[k] = inertia.value[w, k]
    meet()
    rows = inertia.first.shape[0]
    for back in range(rows):
        first = inertia.first[rows - 1 - back]
        last = first + inertia.length[rows - 1 - back] - 1
        for ahead in range(last - first):
            k = last - 1 - ahead
            share = L[k] / L[last]
            above = inertia.first[inertia.column[k]]
            for j in range(lane, k - first + 1, lanes):
                L[above + j] = L[above + j] - share * L[first + j]
            meet()
            if lane == 0:
                L[k] = share


@wp.func
def _solve_unit(
    inertia: _Inertia, L: wp.array(dtype=wp.float32), unit: wp.int32, inverse: wp.array2d(dtype=wp.float32)
):
    """Column ``unit`` of the inverse (V, V): the accelerations of a force of 1."""
    n = inertia.first.shape[0]
    for i in range(n):
        inverse[i, unit] = wp.where(i == unit, 1.0, 0.0)
    for back in range(n):
        i = n - 1 - back
        last = inertia.first[i] + inertia.length[i] - 1
        x = inverse[i, unit]
        if x != 0.0:
            for k in range(inertia.first[i], last):
                inverse[inertia.column[k], unit] = inverse[inertia.column[k], unit] - L[k] * x
            inverse[i, unit] = x / L[last]
    for i in range(n):
        x = inverse[i, unit]
        for k in range(inertia.first[i], inertia.first[i] + inertia.length[i] - 1):
            x -= L[k] * inverse[inertia.column[k], unit]
        inverse[i, unit] = x


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


@wp.func
def _lay_out(rows: _Rows, w: wp.int32, r: wp.int32, used: wp.int32, lane: wp.int32, lanes: wp.int32, out: _Scratch):
    """Write what the ``used`` rows of friction of the contact that begins with row r do, and its A."""
    A = wp.mat33()
    for i in range(lane, out.inverse.shape[1], lanes):
        j, y = wp.vec3(), wp.vec3()
        for d in range(used):
            row = r + 1 + d
            for k in range(rows.first[w, row], rows.first[w, row] + rows.length[w, row]):
                column, value = rows.column[w, 0, k], rows.value[w, 0, k]
                y[d] += out.inverse[w, column, i] * value
                if column == i:
                    j[d] = value
            out.jacobian[w, row, i] = j[d]
            out.answer[w, row, i] = y[d]
        A += wp.outer(j, y)
    for d in range(3):
        for e in range(d + 1):
            A[d, e] = lanes_sum(A[d, e])
            A[e, d] = A[d, e]
        A[d, d] = wp.where(d < used, wp.max(A[d, d], _LEAST), 1.0)
    out.block[w, r] = A


@wp.func
def _friction(rows: _Rows, w: wp.int32, r: wp.int32, used: wp.int32):
    """Friction (3,) of the contact that begins with row r."""
    f = wp.vec3()
    for d in range(used):
        f[d] = rows.force[w, r + 1 + d]
    return f


@wp.func
def _harden(
    rows_out: _Rows,
    scratch: _Scratch,
    w: wp.int32,
    r: wp.int32,
    used: wp.int32,
    lane: wp.int32,
    lanes: wp.int32,
    acceleration_out: wp.array(dtype=wp.float32),
):
    """Find the friction of the contact that begins with row r afresh."""
    c, normal = rows_out.contact[w, r], rows_out.force[w, r]
    rest = wp.vec3()
    for i in range(lane, acceleration_out.shape[0], lanes):
        for d in range(used):
            rest[d] += scratch.jacobian[w, r + 1 + d, i] * acceleration_out[i]
    for d in range(3):
        rest[d] = lanes_sum(rest[d])
        if d < used:
            rest[d] -= rows_out.aim[w, r + 1 + d]
    before = _friction(rows_out, w, r, used)
    mu = wp.vec3(rows_out.friction[c, 0], rows_out.friction[c, 1], wp.where(used > 2, rows_out.friction[c, 2], 1.0))
    A = scratch.block[w, r]
    more = _cheapest(A, rest - A * before, mu, normal) - before
    if wp.dot(more, 0.5 * (A * more) + rest) <= _LEAST:
        meet()
        for d in range(used):
            if lane == 0:
                rows_out.force[w, r + 1 + d] = before[d] + more[d]
            for i in range(lane, acceleration_out.shape[0], lanes):
                acceleration_out[i] = acceleration_out[i] + scratch.answer[w, r + 1 + d, i] * more[d]
        meet()


@wp.kernel
def noslip(
    inertia: _Inertia,
    smooth: wp.array2d(dtype=wp.float32),
    constraint: wp.array2d(dtype=wp.float32),
    iterations: wp.int32,
    lanes: wp.int32,
    rows_out: _Rows,
    scratch_out: _Scratch,
    acceleration_out: wp.array2d(dtype=wp.float32),
):
    """Find the friction of every contact of each world afresh; (W, lanes).

    Args:
        smooth: (W, V) forces without constraints [N or N m].
        constraint: (W, V) those of constraints.
        acceleration_out: (W, V), where there are constraints.
    """
    w, lane = wp.tid()
    end = wp.min(rows_out.count[w], rows_out.kinds.shape[1])
    if end == 0:
        return
    _factor(inertia, w, lane, lanes, scratch_out.factor[w])
    meet()
    V = acceleration_out.shape[1]
    for i in range(lane, V, lanes):
        _solve_unit(inertia, scratch_out.factor[w], i, scratch_out.inverse[w])
        a = float(0.0)
        for k in range(V):
            a += scratch_out.inverse[w, k, i] * (smooth[w, k] + constraint[w, k])
        acceleration_out[w, i] = a
    for it in range(iterations):
        r = int(0)
        while r < end:
            ahead = int(1)
            if rows_out.kinds[w, r] == rows_out.elliptic:
                ahead = rows_out.directions[rows_out.contact[w, r]]
                used = wp.min(ahead - 1, 3)
                if used >= 2 and r + ahead <= end and rows_out.force[w, r] > 0.0:
                    if it == 0:
                        _lay_out(rows_out, w, r, used, lane, lanes, scratch_out)
                    _harden(rows_out, scratch_out, w, r, used, lane, lanes, acceleration_out[w])
            r += ahead


class NoSlip:
    """Takes the creep out of friction, in place.

    Args:
        m, d: MuJoCo Warp's model and data: sparse Jacobian, elliptic cones, contacts of at most four directions.
        iterations: sweeps over all contacts.
    """

    def __init__(self, m: Any, d: Any, iterations: int) -> None:
        self._d, self._iterations, self._lanes = d, iterations, lanes_of(d.M.device)
        self._inertia = make_struct(_Inertia, length=m.M_rownnz, first=m.M_rowadr, column=m.M_colind, value=d.M)
        e, c, worlds, room = d.efc, d.contact, d.nworld, d.njmax
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
            directions=c.dim,
            friction=friction,
        )
        self._scratch = make_struct(
            _Scratch,
            factor=wp.empty(d.M.shape, dtype=wp.float32),
            inverse=wp.empty((worlds, m.nv, m.nv), dtype=wp.float32),
            jacobian=wp.empty((worlds, room, m.nv), dtype=wp.float32),
            answer=wp.empty((worlds, room, m.nv), dtype=wp.float32),
            block=wp.empty((worlds, room), dtype=wp.mat33),
        )

    def run(self) -> None:
        """Change the friction that the solver found, and with it the accelerations ``qacc``."""
        d = self._d
        wp.launch(
            noslip,
            (d.nworld, self._lanes),
            [self._inertia, d.qfrc_smooth, d.qfrc_constraint, self._iterations, self._lanes],
            [self._rows, self._scratch, d.qacc],
            block_dim=2 * LANES,
        )

"""How deep rigid solids are in one another, summed over points of their surfaces, with derivatives by their poses."""

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.differentiable.solids import RUN, PointSolid
from lgrasp.sequence.optimiser.culling import Culling, Kept

_SUM_UNIT = 2.0**-48
"""Sums are made in integers of this unit: exact in any order, so no result depends on batch, threads or atomics. Their
range is 32,768: metres, or points that pull."""


_ENTRIES_PER_ROW = (128, 32, 1024, 256, 128, 384)
"""Pairs with balls that meet, pairs that may touch, their runs, those with balls that meet, those that
may touch, points inside."""


class _Entries(NamedTuple):
    """Runs of points that may be inside a solid; all (E,) int64."""

    row: torch.Tensor
    points: torch.Tensor  # solid of the points
    grid: torch.Tensor  # solid that they are looked up in
    term: torch.Tensor
    run: torch.Tensor

    def at(self, index: torch.Tensor) -> "_Entries":
        return _Entries(*(column.index_select(0, index) for column in self))


def _counted(x: torch.Tensor) -> torch.Tensor:
    return (x * (1 / _SUM_UNIT)).round().to(torch.int64)


def _product(A: torch.Tensor, B: torch.Tensor) -> torch.Tensor:
    """A B of matrices (..., 3, 3), with the same rounding for any number of them."""
    return A[..., :1] * B[..., :1, :] + A[..., 1:2] * B[..., 1:2, :] + A[..., 2:] * B[..., 2:, :]


def _turned(R: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """R v of vectors (..., 3)."""
    return R[..., 0] * v[..., :1] + R[..., 1] * v[..., 1:2] + R[..., 2] * v[..., 2:]


def _placed(
    M: Sequence[torch.Tensor], m: Sequence[torch.Tensor], x: Sequence[torch.Tensor]
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """M x + m by components: M in rows."""
    a, b, c = (M[k] * x[0] + M[k + 1] * x[1] + M[k + 2] * x[2] + m[k // 3] for k in (0, 3, 6))
    return a, b, c


class PenetrationSums:
    """Sums of depths [m] over surface points, by term, of pairs of solids that ride on frames.

    Both ways: points of each solid of a pair in the distance grid of the other. Balls around solids and around runs of
    points leave out what is apart.

    Args:
        solids: P of them. frame: the frame that each rides on, (P,).
        pairs: (Q, 2) solids; where the two differ in size, the smaller first is faster.
        counts: (Q, 2) the sum that counts the points of the first, and of the second, of a pair.
        terms: how many sums.
    """

    def __init__(
        self,
        solids: Sequence[PointSolid],
        frame: Sequence[int] | np.ndarray,
        pairs: np.ndarray,
        counts: np.ndarray,
        terms: int,
        *,
        dtype: torch.dtype = torch.float32,
        device: str | torch.device = "cpu",
    ) -> None:
        put, index = (partial(torch.as_tensor, dtype=kind, device=device) for kind in (dtype, torch.int64))
        runs = [len(s.run_ball) for s in solids]
        self.terms = terms
        self._grids = DistanceGrids([s.grid for s in solids], dtype=dtype, device=device)
        self._frame, self._pairs, self._pair_terms = index(frame), index(pairs), index(counts)
        self._ball = put(np.stack([s.ball for s in solids]))
        self._run_ball = put(np.concatenate([s.run_ball for s in solids]))
        self._run_frame = index(np.repeat(np.asarray(frame), runs))
        self._run_first, self._run_count = index(np.cumsum([0, *runs[:-1]])), index(runs)
        self.culling = Culling(_ENTRIES_PER_ROW, device)
        points = np.concatenate([s.points for s in solids])
        self._points = put(points.reshape(-1, RUN * 3))

    def __call__(self, R: torch.Tensor, t: torch.Tensor) -> torch.Tensor:
        """Sums of depths [m], (N, terms), with frames at R (N, F, 3, 3) and t (N, F, 3) [m]; differentiable once."""
        out = _Sums.apply(R, t, self)
        assert isinstance(out, torch.Tensor)
        return out

    def near(self, R: torch.Tensor, t: torch.Tensor) -> tuple[_Entries, Kept]:
        """Runs of points that may be inside the other solid of their pair."""
        flat = R.reshape(-1, 3, 3), t.reshape(-1, 3)
        frames, keep = t.shape[1], self.culling.keep
        centre = self._centres(R, t, self._frame, self._ball)  # (N, P, 3)
        a, b = self._pairs.unbind(1)
        gap = [x.index_select(1, a) - x.index_select(1, b) for x in centre.unbind(2)]
        reach = self._ball[a, 3] + self._ball[b, 3]
        close = gap[0] * gap[0] + gap[1] * gap[1] + gap[2] * gap[2] < reach * reach  # (N, Q)
        kept = keep(0, close.reshape(-1))
        row, pair = kept.index // len(a), kept.index % len(a)

        def distance(row: torch.Tensor, centre: torch.Tensor, grid: torch.Tensor) -> torch.Tensor:
            """Of points (E, 3) of the common frame, in the grids of solids."""
            at = row * frames + self._frame[grid]
            p, M = (centre - flat[1][at]).unbind(1), flat[0][at].reshape(-1, 9).unbind(1)
            local = tuple(M[k] * p[0] + M[3 + k] * p[1] + M[6 + k] * p[2] for k in range(3))
            return self._grids.value_and_gradient((local[0], local[1], local[2]), grid)[0] - self._grids.cell[grid]

        a, b = a[pair], b[pair]
        kept = keep(1, kept.allowed(distance(row, centre[row, a], b) < self._ball[a, 3]))
        row, a, b, pair = row[kept.index], a[kept.index], b[kept.index], pair[kept.index]
        # both ways, and every run of the points' solid
        row, points, grid = torch.cat([row, row]), torch.cat([a, b]), torch.cat([b, a])
        term, count = self._pair_terms[pair].t().reshape(-1), self._run_count[points]
        if kept.used is not None:
            count = torch.where(torch.cat([kept.used, kept.used]), count, 0)
        kept, number = self.culling.repeat(2, count)
        run = self._run_first[points][kept.index] + number
        e = _Entries(row[kept.index], points[kept.index], grid[kept.index], term[kept.index], run)
        run_centre = self._centres(R, t, self._run_frame, self._run_ball)  # (N, runs, 3)
        x, y, z = (run_centre[e.row, e.run] - centre[e.row, e.grid]).unbind(1)
        reach = self._run_ball[e.run, 3] + self._ball[e.grid, 3]
        kept = keep(3, kept.allowed(x * x + y * y + z * z < reach * reach))
        e = e.at(kept.index)
        apart = distance(e.row, run_centre[e.row, e.run], e.grid)
        kept = keep(4, kept.allowed(apart < self._run_ball[e.run, 3]))
        return e.at(kept.index), kept

    def _centres(self, R: torch.Tensor, t: torch.Tensor, frame: torch.Tensor, ball: torch.Tensor) -> torch.Tensor:
        return _turned(R.index_select(1, frame), ball[:, :3]) + t.index_select(1, frame)

    def slopes(self, R: torch.Tensor, t: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """The sums (N, terms) and their derivatives by [R | t] of each frame, (N, terms, F, 3, 4)."""
        batch, frames = t.shape[:2]
        e, kept = self.near(R, t)
        at_a, at_b = e.row * frames + self._frame[e.points], e.row * frames + self._frame[e.grid]
        flat = R.reshape(-1, 3, 3), t.reshape(-1, 3)
        Ra, Rb = flat[0][at_a], flat[0][at_b]
        back = Rb.transpose(1, 2)
        R_ba, t_ba = _product(back, Ra), _turned(back, flat[1][at_a] - flat[1][at_b])
        x = self._points[e.run].reshape(-1, RUN, 3).unbind(2)  # each (E, RUN)
        z = _placed(R_ba.reshape(-1, 9, 1).unbind(1), t_ba[..., None].unbind(1), x)
        inside = kept.allowed(self._grids.value_within(z, e.grid[:, None]) < 0)
        kept = self.culling.keep(5, inside.reshape(-1))
        entry = kept.index // RUN
        x, (a, b, c) = ([y.reshape(-1).index_select(0, kept.index) for y in v] for v in (x, z))  # (points inside,)
        value, gradient = self._grids.value_and_gradient((a, b, c), e.grid[entry])
        # of the depth, frame of the grid: its gradient h, and h x^T
        rows = torch.stack([-value, *(-g for g in gradient), *(-g * y for g in gradient for y in x)], 1)
        if kept.used is not None:
            rows = torch.where(kept.used[:, None], rows, 0)
        summed = torch.zeros(len(e.row), 13, dtype=torch.int64, device=R.device)
        summed.index_add_(0, entry, _counted(rows))
        pull, lever = (summed[:, 1:].to(R.dtype) * _SUM_UNIT).split([3, 9], 1)
        lever = lever.reshape(-1, 3, 3)
        force = _turned(Rb, pull)
        by_a = torch.cat([_product(Rb, lever), force[..., None]], 2)
        moment = _product(R_ba, lever.transpose(1, 2)) + t_ba[..., None] * pull[:, None]  # sum of z h^T
        by_b = torch.cat([_product(Rb, moment), -force[..., None]], 2)
        slot = e.row * self.terms + e.term
        sums = torch.zeros(batch * self.terms, dtype=torch.int64, device=R.device)
        sums.index_add_(0, slot, summed[:, 0])
        place = torch.cat([slot * frames + self._frame[e.points], slot * frames + self._frame[e.grid]])
        slopes = torch.zeros(batch * self.terms * frames, 12, dtype=torch.int64, device=R.device)
        slopes.index_add_(0, place, _counted(torch.cat([by_a, by_b])).reshape(-1, 12))
        slopes = slopes.to(R.dtype) * _SUM_UNIT
        return (sums.to(R.dtype) * _SUM_UNIT).reshape(batch, -1), slopes.reshape(batch, self.terms, frames, 3, 4)


class _Sums(torch.autograd.Function):
    @staticmethod
    def forward(ctx, R: torch.Tensor, t: torch.Tensor, scene: PenetrationSums) -> torch.Tensor:
        sums, slopes = scene.slopes(R, t)
        ctx.save_for_backward(slopes)
        return sums

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, *grads: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, None]:
        (slopes,) = ctx.saved_tensors
        weighted = slopes * grads[0][..., None, None, None]
        total = weighted[:, 0]
        for k in range(1, weighted.shape[1]):
            total = total + weighted[:, k]
        return total[..., :3], total[..., 3], None

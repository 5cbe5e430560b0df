"""Signed distance grids in torch: trilinear values with their true gradient, and smooth surface normals."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.object.sdf import SdfGrid

_CELLS_BELOW_TOP = 1.001
"""Points are clamped this many cells below the number of nodes, as in lgrasp.math.sdf."""


class _Cells(NamedTuple):
    """Grids of points: every entry broadcasts against the points."""

    first: torch.Tensor  # place of node (0, 0, 0)
    stride: tuple[torch.Tensor, torch.Tensor]  # nodes from one x, and one y, to the next
    top: tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # where points are clamped [cells]
    origin: tuple[torch.Tensor, torch.Tensor, torch.Tensor]  # [m]
    inv_cell: torch.Tensor  # [1/m]


_Three = tuple[torch.Tensor, torch.Tensor, torch.Tensor]


def _node(whole: torch.Tensor) -> torch.Tensor:
    """Whole numbers as indices; 0 for NaN, whose shares in the cell are NaN."""
    return whole.nan_to_num().to(torch.int64)


def _in_cells(cells: _Cells, p: _Three) -> tuple[list[torch.Tensor], list[torch.Tensor]]:
    """Points in cells of their grid, and the nearest ones that are in it."""
    u = [(x - o) * cells.inv_cell for x, o in zip(p, cells.origin, strict=True)]
    return u, [x.clamp_min(0).minimum(top) for x, top in zip(u, cells.top, strict=True)]


def _corners(
    values: torch.Tensor, cells: _Cells, c: list[torch.Tensor]
) -> tuple[list[torch.Tensor], list[tuple[torch.Tensor, torch.Tensor]]]:
    """Shares (x, y, z) of points in a cell, and the values at its corners: pairs along z, for y, for x."""
    whole = [x.detach().floor() for x in c]
    i, j, k = map(_node, whole)
    sx, sy = cells.stride
    a = cells.first + i * sx + j * sy + k
    edges = [a, a + sy, a + sx, a + sx + sy]
    return [x - y for x, y in zip(c, whole, strict=True)], [(values.take(e), values.take(e + 1)) for e in edges]


def _interpolate(values: torch.Tensor, cells: _Cells, p: _Three) -> tuple[torch.Tensor, _Three]:
    """Signed distance [m] and its gradient at points given by components; see :meth:`DistanceGrids.value`."""
    u, c = _in_cells(cells, p)
    (fx, fy, fz), edges = _corners(values, cells, c)
    d00, d01, d10, d11 = (high - low for low, high in edges)
    v00, v01, v10, v11 = (low + d * fz for (low, _), d in zip(edges, (d00, d01, d10, d11), strict=True))
    e0, e1 = v01 - v00, v11 - v10
    v0, v1 = v00 + e0 * fy, v10 + e1 * fy
    d0, d1 = d00 + (d01 - d00) * fy, d10 + (d11 - d10) * fy
    v = v0 + (v1 - v0) * fx
    g = ((v1 - v0) * cells.inv_cell, (e0 + (e1 - e0) * fx) * cells.inv_cell, (d0 + (d1 - d0) * fx) * cells.inv_cell)
    # beyond the grid: the surface is inside it, so it is no nearer than this
    o = [(x - y) / cells.inv_cell for x, y in zip(u, c, strict=True)]
    o2 = o[0] * o[0] + o[1] * o[1] + o[2] * o[2]
    beyond = o2 > 0
    apart = v.clamp_min(0)
    far = torch.where(beyond, o2 + apart * apart, 1).sqrt()
    share = torch.where(beyond, apart / far, 1)
    x, y, z = (torch.where(w != 0, 0, share * s) + w / far for s, w in zip(g, o, strict=True))
    return torch.where(beyond, far, v), (x, y, z)


class _Value(torch.autograd.Function):
    """Value whose derivative is known from the look-up itself; its own derivative comes from the same formula."""

    @staticmethod
    def forward(ctx, p: torch.Tensor, values: torch.Tensor, cells: _Cells) -> torch.Tensor:
        x, y, z = p.unbind(-1)
        value, gradient = _interpolate(values, cells, (x, y, z))
        ctx.save_for_backward(p, torch.stack(gradient, -1))
        ctx.grids = values, cells
        return value

    @staticmethod
    def backward(ctx, *grads: torch.Tensor) -> tuple[torch.Tensor, None, None]:
        p, gradient = ctx.saved_tensors
        if torch.is_grad_enabled():  # a derivative of this derivative is asked for
            x, y, z = p.unbind(-1)
            values, cells = ctx.grids
            gradient = torch.stack(_interpolate(values, cells, (x, y, z))[1], -1)
        return grads[0][..., None] * gradient, None, None


class DistanceGrids:
    """Signed distance grids side by side in one array; points name the grid that they are looked up in."""

    def __init__(
        self, grids: Sequence[SdfGrid], *, dtype: torch.dtype = torch.float32, device: str | torch.device = "cpu"
    ) -> None:
        def put(a: object) -> torch.Tensor:
            return torch.as_tensor(np.asarray(a), dtype=dtype, device=device)

        shape = np.array([g.values.shape for g in grids])
        sizes = [g.values.size for g in grids]
        index = torch.as_tensor(np.column_stack([shape, np.cumsum([0, *sizes[:-1]])]), device=device)
        self.values = torch.cat([put(g.values).reshape(-1) for g in grids])
        self.cell = put([g.cell for g in grids])
        self._first, self._nz = index[:, 3], index[:, 2]
        self._plane = index[:, 1] * index[:, 2]
        self._top = put(shape - _CELLS_BELOW_TOP)
        self._origin = put(np.array([g.origin for g in grids]))
        self._inv_cell = 1 / self.cell
        self._only = self.values.reshape(1, 1, *shape[0].tolist()) if len(grids) == 1 else None
        self._sides = put((shape[0] - 1) * grids[0].cell)

    def cells(self, grid: torch.Tensor | int) -> _Cells:
        """Where the grids lie that points use; ``grid`` broadcasts against the points."""
        tx, ty, tz = self._top[grid].unbind(-1)
        ox, oy, oz = self._origin[grid].unbind(-1)
        strides = self._plane[grid], self._nz[grid]
        return _Cells(self._first[grid], strides, (tx, ty, tz), (ox, oy, oz), self._inv_cell[grid])

    def value(self, p: torch.Tensor, grid: torch.Tensor | int = 0) -> torch.Tensor:
        """Signed distance [m], negative inside, (...), at points p (..., 3) [m] of the grids' frames.

        Trilinear inside a grid; beyond it a lower bound of the distance, continuous across the border. Differentiable
        twice with respect to p, within cells.

        Args:
            grid: number of each point's grid, broadcasts against the points (...).
        """
        out = _Value.apply(p, self.values, self.cells(grid))
        assert isinstance(out, torch.Tensor)
        return out

    def value_within(self, p: _Three, grid: torch.Tensor | int) -> torch.Tensor:
        """Signed distance [m] at the points of the grids nearest to points given by components (fast, no graph).

        With the margin that grids have, it is negative where :meth:`value` is, and the same there.
        """
        with torch.no_grad():
            if self._only is not None:
                return self._value_in_only(self._only, p)
            cells = self.cells(grid)
            (fx, fy, fz), edges = _corners(self.values, cells, _in_cells(cells, p)[1])
            v00, v01, v10, v11 = (low + (high - low) * fz for low, high in edges)
            v0, v1 = v00 + (v01 - v00) * fy, v10 + (v11 - v10) * fy
            return v0 + (v1 - v0) * fx

    def _value_in_only(self, only: torch.Tensor, p: _Three) -> torch.Tensor:
        """The same of the only grid: one kernel on a GPU, not forty."""
        scale = 2 / self._sides.flip(0)
        places = torch.stack(p[::-1], -1).mul_(scale).sub_(1 + self._origin[0].flip(0) * scale).reshape(1, 1, 1, -1, 3)
        how = {"mode": "bilinear", "padding_mode": "border", "align_corners": True}
        return torch.nn.functional.grid_sample(only, places, **how).reshape(p[0].shape)

    def value_and_gradient(self, p: _Three, grid: torch.Tensor | int) -> tuple[torch.Tensor, _Three]:
        """As :meth:`value`, with the gradient, both of points given by components (faster; keeps no graph)."""
        with torch.no_grad():
            return _interpolate(self.values, self.cells(grid), p)


class SurfaceNormals:
    """Outward unit normals of the level sets of a distance grid, smooth enough to be differentiated.

    Central differences at the nodes, interpolated trilinearly: unlike the gradient of the interpolated distance they
    are continuous, and turn as the surface turns.
    """

    def __init__(
        self, grid: SdfGrid, *, dtype: torch.dtype = torch.float32, device: str | torch.device = "cpu"
    ) -> None:
        slopes = np.stack([*np.gradient(grid.values, grid.cell), grid.values], -1)
        self._slopes = torch.as_tensor(slopes, dtype=dtype, device=device).reshape(-1, 4)
        shape = np.array(grid.values.shape)
        self._top = torch.as_tensor(shape - _CELLS_BELOW_TOP, dtype=dtype, device=device)
        self._origin = torch.as_tensor(grid.origin, dtype=dtype, device=device)
        self._inv_cell = 1 / grid.cell
        _, ny, nz = shape.tolist()
        self._stride = torch.tensor([ny * nz, nz, 1], device=device)
        corners = np.indices((2, 2, 2)).reshape(3, 8).T
        self._corners = torch.as_tensor(corners, device=device)

    def __call__(self, p: torch.Tensor) -> torch.Tensor:
        """Unit normals (..., 3) at points p (..., 3) [m] of the grid's frame.

        Beyond the grid: the direction from the surface as seen from the nearest point of the grid.
        """
        u = (p - self._origin) * self._inv_cell
        c = u.clamp_min(0).minimum(self._top)
        whole = c.detach().floor()
        f = (c - whole)[..., None, :]  # (..., 1, 3)
        at = ((_node(whole)[..., None, :] + self._corners) * self._stride).sum(-1)  # (..., 8)
        w = torch.where(self._corners == 1, f, 1 - f)
        w = w[..., 0] * w[..., 1] * w[..., 2]  # (..., 8)
        mixed = (self._slopes[at] * w[..., None]).sum(-2)  # (..., 4)
        n = mixed[..., :3] / mixed[..., :3].norm(dim=-1, keepdim=True).clamp_min(1e-9)
        beyond = (u - c) / self._inv_cell
        far = (beyond != 0).any(-1, keepdim=True)
        seen = torch.where(far, beyond + n * mixed[..., 3:], n)
        return torch.where(far, seen / seen.norm(dim=-1, keepdim=True).clamp_min(1e-9), n)

"""The network that completes clouds: distances to what was seen -> signed distances of the whole object."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from lgrasp.object.sdf import SdfGrid

CHANNELS = 5
SHARES = 0.15, 0.5, 0.85
"""The object reaches so likely to each of the surfaces that are guessed, from the widest to the narrowest."""

LIKELY = 1
"""Of these, the one that it is as likely to lie within as beyond."""

ONE_SIDED = 0.35
"""Length of the mean normal above which a cloud shows one side."""

_MARGIN, _PAD = 1.25, 0.015  # half side of the cube over the cloud's radius, and beyond that [m]
_NEAR = 4.0  # cells within which signed distances are seen
_RIM = 0.02  # share of the points that lie beyond the rim
_BLOCK = 1 << 25  # distances at a time
_AT_ONCE = 16  # clouds
_DIAGONAL = 3**0.5  # of a cell, over its side
_APART = -4.0  # surfaces are this far apart before any training, by what softplus makes of it


class Cubes(NamedTuple):
    """Cubes of nodes about N clouds, in the frames of these."""

    half: torch.Tensor
    """Half of the side [m], (N,)."""
    seen: torch.Tensor
    """Distances from the nearest points in half sides, negative behind them, (N, n, n, n)."""
    base: torch.Tensor
    """The same of a first guess: a cloud of one side is closed by its mirror image behind the rim."""
    one_sided: torch.Tensor
    """Length of the mean normal, (N,)."""

    @property
    def values(self) -> torch.Tensor:
        """What the network is given, (N, CHANNELS, n, n, n)."""
        n = self.seen.shape[-1]
        near, height = 2 * _NEAR / n, torch.linspace(-1, 1, n, device=self.seen.device)
        told = [(self.seen / near).clamp(-1, 1), (self.base / near).clamp(-1, 1), self.seen.abs()]
        told += [x.expand_as(self.seen) for x in (height, self.one_sided[:, None, None, None])]
        return torch.stack(told, 1)

    def some(self, index: torch.Tensor) -> "Cubes":
        """Some of them, by index, in single precision."""
        return Cubes(*(x[index].float() for x in self))


def unit_nodes(count: int, device: torch.device) -> torch.Tensor:
    """Nodes of a cube with corners at -1 and 1, (count^3, 3)."""
    line = torch.linspace(-1, 1, count, device=device)
    return torch.stack(torch.meshgrid(line, line, line, indexing="ij"), -1).reshape(-1, 3)


def cubes_of(points: torch.Tensor, normals: torch.Tensor, count: int) -> Cubes:
    """Cubes with ``count`` nodes along a side.

    Args:
        points: about their middle, z out of the side that was seen, (N, k, 3) [m]. normals: (N, k, 3).
    """
    half = _MARGIN * points.norm(dim=2).amax(1) + _PAD
    nodes = unit_nodes(count, points.device)
    one_sided = normals.mean(1).norm(dim=1)
    found = []
    for cloud, normal, h, length in zip(points, normals, half, one_sided, strict=True):
        base = seen = _distances(nodes * h, cloud, normal)
        if length > ONE_SIDED:
            flip = torch.tensor([1.0, 1.0, -1.0], device=points.device)
            rim = torch.zeros(3, device=points.device)
            rim[2] = 2 * cloud[:, 2].quantile(_RIM)
            base = seen.maximum(_distances(nodes * h, cloud * flip + rim, normal * flip))
        found.append(torch.stack([seen, base]) / h)
    seen, base = torch.stack(found, 1).unflatten(2, (count, count, count))
    return Cubes(half, seen, base, one_sided)


def _distances(x: torch.Tensor, points: torch.Tensor, normals: torch.Tensor) -> torch.Tensor:
    """Distance of places x (m, 3) from the nearest point [m], negative behind it."""
    found = [torch.cdist(part, points).min(1) for part in x.split(max(1, _BLOCK // len(points)))]
    away, which = (torch.cat(parts) for parts in zip(*found, strict=True))
    return torch.where(((x - points[which]) * normals[which]).sum(1) < 0, -away, away)


class CompletionNet(nn.Module):
    """A U-Net on cubes with ``channels`` at the finest of four levels; it corrects their first guess, and tells how
    sure it is."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        sizes = [channels << k for k in range(4)]
        self.down = nn.ModuleList(
            _Block(a, b, stride) for a, b, stride in zip([CHANNELS, *sizes[:-1]], sizes, (1, 2, 2, 2), strict=True)
        )
        self.up = nn.ModuleList(_Block(a + b, a, 1) for a, b in pairwise(sizes))
        self.out = nn.Conv3d(channels, len(SHARES), 1)
        nn.init.zeros_(self.out.weight)
        self.out.bias = nn.Parameter(torch.tensor([_APART, 0.0, _APART]))

    def forward(self, cubes: Cubes) -> torch.Tensor:
        """Signed distances from the surfaces SHARES in half sides, (N, 3, n, n, n)."""
        seen, x = [], cubes.values
        with torch.autocast(x.device.type, torch.bfloat16, enabled=self.training and x.is_cuda):
            for block in self.down:
                x = block(x)
                seen.append(x)
            for block, finer in zip(reversed(self.up), reversed(seen[:-1]), strict=True):
                x = functional.interpolate(x, size=finer.shape[2:], mode="trilinear", align_corners=False)
                x = block(torch.cat([finer, x], 1))
        wider, guess, narrower = self.out(x.float()).unbind(1)
        likely = guess + cubes.base
        return torch.stack([likely - functional.softplus(wider), likely, likely + functional.softplus(narrower)], 1)


class _Block(nn.Module):
    def __init__(self, a: int, b: int, stride: int) -> None:
        super().__init__()
        self.first, self.second = nn.Conv3d(a, b, 3, stride, 1), nn.Conv3d(b, b, 3, 1, 1)
        self.norms = nn.ModuleList(nn.GroupNorm(1, b) for _ in range(2))

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        x = functional.silu(self.norms[0](self.first(x)))
        return functional.silu(self.norms[1](self.second(x)))


@torch.no_grad()
def completed_grids(
    net: CompletionNet, points: torch.Tensor, normals: torch.Tensor, count: int
) -> list[tuple[SdfGrid, ...]]:
    """Signed distances from the surfaces SHARES of whole objects, guessed from clouds, in the frames of these.

    Args:
        points, normals: as of :func:`cubes_of`. count: nodes along a side.
    """
    grids = []
    for some in torch.arange(len(points), device=points.device).split(_AT_ONCE):
        cubes = cubes_of(points[some], normals[some], count)
        values = net(cubes) * cubes.half[:, None, None, None, None]
        cells = 2 * cubes.half / (count - 1)
        values = without_specks(values.flatten(0, 1), cells.repeat_interleave(len(SHARES)))
        for h, cell, surfaces in zip(
            cubes.half.tolist(), cells.tolist(), values.unflatten(0, (-1, len(SHARES))).cpu().numpy(), strict=True
        ):
            grids.append(tuple(SdfGrid(x.astype(np.float32), np.full(3, -h, np.float32), cell) for x in surfaces))
    return grids


def without_specks(values: torch.Tensor, cell: torch.Tensor) -> torch.Tensor:
    """Distances (N, n, n, n) [m] on grids of spacing cell (N,) [m]: what differs from the median of the nodes about it
    by more than distances can is that median. A network guesses the inside here and there where it is far."""
    h, steep = cell[:, None, None, None], torch.zeros_like(values, dtype=torch.bool)
    for axis in (1, 2, 3):
        jump = values.diff(dim=axis).abs() > h
        steep.narrow(axis, 0, jump.shape[axis]).logical_or_(jump)
        steep.narrow(axis, 1, jump.shape[axis]).logical_or_(jump)
    row, *node = (x[:, None] for x in steep.nonzero().unbind(1))  # few
    step = torch.cartesian_prod(*3 * [torch.arange(-1, 2, device=values.device)])
    about = [(x + d).clamp(0, values.shape[1] - 1) for x, d in zip(node, step.T, strict=True)]
    middle = values[row, *about].median(1).values
    out = values.clone()
    out[steep] = torch.where((out[steep] - middle).abs() > _DIAGONAL * cell[row[:, 0]], middle, out[steep])
    return out

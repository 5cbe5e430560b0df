"""A PointNet in the frame of a point on a cloud: one coarse grasp for each such seed."""

from typing import NamedTuple

import torch
from torch import nn

from lgrasp.geometry.rotations import matrix_from_sixd
from lgrasp.learn.params import LearnParams


class Coarse(NamedTuple):
    """Answers for N seeds, in the frame of their clouds."""

    R: torch.Tensor
    """Rotation of the hand's base, (N, 3, 3)."""
    t: torch.Tensor
    """Its origin [m], (N, 3)."""
    q: torch.Tensor
    """Joint positions within the limits [rad or m], (N, K)."""
    score: torch.Tensor
    """Logit of whether a grasp belongs to the seed, (N,)."""


class CoarseNet(nn.Module):
    """Clouds seen from seeds -> coarse grasps. Whatever turns or moves a cloud turns and moves the answers alike.

    Every seed sees the whole cloud in its own frame (:func:`seed_frames`), so nothing is learnt twice for two
    orientations.

    Args:
        lower, upper: joint limits [rad or m], (K,).
    """

    lower: torch.Tensor
    upper: torch.Tensor

    def __init__(self, lower: torch.Tensor, upper: torch.Tensor, params: LearnParams) -> None:
        super().__init__()
        self.scale, self.points = params.scale, params.points
        w, joints = params.width, len(lower)
        self.point, self.whole = _layers(6, w // 2, w, 2 * w), _layers(2 * w, 2 * w, 2 * w, 10 + joints)
        self.register_buffer("lower", lower)
        self.register_buffer("upper", upper)

    def forward(self, points: torch.Tensor, normals: torch.Tensor, seeds: torch.Tensor) -> Coarse:
        """One answer for each seed.

        Args:
            points: cloud of each seed [m], (N, n, 3). normals: unit, outward, (N, n, 3).
            seeds: which of the points, (N,) int64.
        """
        rows = torch.arange(len(seeds), device=seeds.device)
        F, p = seed_frames(points, normals, seeds), points[rows, seeds]
        local = torch.cat([(points - p[:, None]) @ F / self.scale, normals @ F], -1)  # (N, n, 6)
        out = self.whole(self.point(local).amax(1))
        turn = out[:, :6] + torch.tensor([1.0, 0, 0, 0, 1.0, 0], dtype=out.dtype, device=out.device)
        t = p + (F @ (2 * self.scale * out[:, 6:9])[..., None])[..., 0]
        q = self.lower + out[:, 10:].sigmoid() * (self.upper - self.lower)
        return Coarse(F @ matrix_from_sixd(turn), t, q, out[:, 9])


def _layers(a: int, b: int, c: int, d: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(a, b), nn.ReLU(), nn.Linear(b, c), nn.ReLU(), nn.Linear(c, d))


@torch.no_grad()
def best_answers(net: CoarseNet, points: torch.Tensor, normals: torch.Tensor, count: int) -> Coarse:
    """The ``count`` answers with the highest score for one cloud, best first, in its frame.

    Args:
        points: any number of points [m], (n, 3); some are drawn. normals: unit, outward, (n, 3).
    """
    draw = torch.Generator().manual_seed(0)
    kept = torch.randperm(len(points), generator=draw)[: net.points]
    kept = kept.repeat(-(-net.points // len(kept)))[: net.points].to(points.device)
    n = len(kept)
    every = net(points[kept].expand(n, n, 3), normals[kept].expand(n, n, 3), torch.arange(n, device=points.device))
    best = every.score.topk(min(count, n)).indices
    return Coarse(*(x[best] for x in every))


def seed_frames(points: torch.Tensor, normals: torch.Tensor, seeds: torch.Tensor) -> torch.Tensor:
    """Axes of seeds as columns, (N, 3, 3): z along the normal, x towards the middle of the cloud as far as z allows.

    Args:
        points: (N, n, 3) [m]. normals: (N, n, 3). seeds: (N,) int64.
    """
    rows = torch.arange(len(seeds), device=seeds.device)
    z = normals[rows, seeds]
    way = points.mean(1) - points[rows, seeds]
    least = nn.functional.one_hot(z.abs().argmin(1), 3).to(z)  # where the middle lies straight below
    x = way - (way * z).sum(1, keepdim=True) * z
    x = torch.where(x.norm(dim=1, keepdim=True) > 1e-4, x, least - (least * z).sum(1, keepdim=True) * z)
    x = x / x.norm(dim=1, keepdim=True)
    return torch.stack([x, torch.linalg.cross(z, x), z], -1)

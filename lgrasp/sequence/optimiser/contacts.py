"""Which points of the two sides of an opposition space a finished grasp touches with."""

import math

import torch

from lgrasp.geometry.rotations import matrix_from_sixd
from lgrasp.sequence.optimiser.problem import GraspProblem

_GAP_SCALE = 0.002  # [m]
_ANGLE_SCALE = 1 - math.cos(math.radians(20))
_BALANCE_SCALE = 0.1
"""A gap [m], 1 - cosine of the angle of the normals, and an energy fc that count alike."""
_POINTS_EXAMINED, _POINTS_PAIRED = 32, 12  # points of a side whose normals are looked at, and those that are paired


@torch.no_grad()
def touching_points(problem: GraspProblem, x: torch.Tensor) -> torch.Tensor:
    """The pair of points, one of each side and numbered from 0 there, that touches and balances best, (N, 2) int64.

    The energies take single points out of each side at random; a finished grasp touches with whatever is nearest.

    Args:
        x: (N, 9 + K) coordinates of a :class:`GraspProblem`.
    """
    points, listed = problem.sides.points(problem.space)  # (N, 2, P)
    R, t = matrix_from_sixd(x[:, 3:9]), x[:, :3]
    bodies = problem.energy.kinematics(x[:, 9:])
    at, _ = problem.sides.placed(points, bodies)
    local = _back(R, at - t[:, None, None])
    gap = torch.where(listed, problem.energy.distance(local).abs(), torch.inf)
    gap, near = gap.topk(min(_POINTS_EXAMINED, gap.shape[2]), largest=False)
    points = points.gather(2, near)
    local, normal = torch.take_along_dim(local, near[..., None], 2), _back(R, problem.sides.placed(points, bodies)[1])
    outward = problem.energy.normals(local)
    badness = gap / _GAP_SCALE + (1 + (normal * outward).sum(-1)) / _ANGLE_SCALE
    badness, best = badness.topk(min(_POINTS_PAIRED, gap.shape[2]), largest=False)  # (N, 2, B)
    chosen = [torch.take_along_dim(v, best[..., None], 2) for v in (local, outward)]
    pair = [v[:, side] for v in chosen for side in (0, 1)]  # each (N, B, 3): places of both sides, normals of both
    first, second = (v.shape[1] for v in pair[:2])
    x2 = torch.stack([pair[0][:, :, None].expand(-1, -1, second, 3), pair[1][:, None].expand(-1, first, -1, 3)], 3)
    n2 = torch.stack([pair[2][:, :, None].expand(-1, -1, second, 3), pair[3][:, None].expand(-1, first, -1, 3)], 3)
    fc = problem.energy.balance(x2.reshape(-1, 2, 3), n2.reshape(-1, 2, 3)).reshape(len(x), first, second)
    total = badness[:, 0, :, None] + badness[:, 1, None] + fc / _BALANCE_SCALE
    flat = total.flatten(1).argmin(1)
    rank = torch.stack([flat // second, flat % second], 1)[..., None]
    return near.gather(2, best.gather(2, rank))[..., 0]


def _back(R: torch.Tensor, v: torch.Tensor) -> torch.Tensor:
    """R^T v of vectors (N, 2, P, 3)."""
    return (R[:, None, None] * v[..., :, None]).sum(-2)

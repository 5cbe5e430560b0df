"""Training of the completing network on views of objects whose distances are known."""

import math
from collections.abc import Callable, Sequence

import torch
from torch.nn import functional

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.learn.grasp.completion import CompletionNet, Cubes, cubes_of, unit_nodes
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.grasp.views import CloudView
from lgrasp.object.sdf import SdfGrid

_TOLD = 20  # steps between two looks at the loss
_REACH = 0.5  # distances beyond this share of half a side are not told apart
_CLOSE = 0.05  # share of half a side at which errors count half as much as at the surface
_WARM = 50  # steps in which the learning rate rises
_AT_ONCE = 16  # views


class ViewSet:
    """Views of O objects, V of each one after another, on one device.

    Args:
        grids: distances of the objects.
    """

    def __init__(self, views: Sequence[CloudView], grids: Sequence[SdfGrid], device: torch.device | str) -> None:
        def put(name: str) -> torch.Tensor:
            parts = [torch.as_tensor(getattr(view, name), dtype=torch.float32) for view in views]
            return torch.stack(parts).to(device)

        self.points, self.normals, self.R, self.t = (put(name) for name in CloudView._fields)
        self.grids = DistanceGrids(grids, device=device)
        self.each = len(views) // len(grids)

    def cubes(self, count: int) -> tuple[Cubes, torch.Tensor]:
        """What the network is given of all views, and the objects' signed distances in half sides, (N, n, n, n)."""
        nodes, parts = unit_nodes(count, self.points.device), []
        for some in torch.arange(len(self.points), device=self.points.device).split(_AT_ONCE):
            cubes = cubes_of(self.points[some], self.normals[some], count)
            h = cubes.half[:, None, None]
            at = (nodes * h) @ self.R[some].mT + self.t[some, None]
            goal = self.grids.value(at, (some // self.each)[:, None]) / h[..., 0]
            parts.append((*cubes, goal.clamp(-_REACH, _REACH).reshape(cubes.base.shape)))
        half, values, base, goal = (torch.cat(x) for x in zip(*parts, strict=True))
        return Cubes(half, values, base), goal


def fit_completion(
    net: CompletionNet,
    views: ViewSet,
    unseen: torch.Tensor,
    p: GraspParams,
    told: Callable[[int, float], None] | None,
) -> float:
    """Train a network in place on all but unseen objects (O,); the mean loss of the last tenth of the steps.

    The loss is the mean error of distances, those near the surface counting most, and how sure the network is of the
    wrong side of it. Cubes are turned by right angles about z and mirrored at random.
    """
    cubes, goals = views.cubes(p.nodes)
    rows = (~unseen).repeat_interleave(views.each).nonzero()[:, 0]
    optimiser = torch.optim.AdamW(net.parameters(), lr=p.completion_rate, weight_decay=1e-4)
    draw = torch.Generator().manual_seed(p.seed)
    recent: list[torch.Tensor] = []
    for step in range(p.completion_steps):
        fall = 0.5 * (1 + math.cos(math.pi * step / p.completion_steps))
        for group in optimiser.param_groups:
            group["lr"] = p.completion_rate * min(1.0, (step + 1) / _WARM) * fall
        chosen = rows[torch.randint(len(rows), (p.completion_batch,), generator=draw)].to(goals.device)
        turn, mirror = (int(torch.randint(n, (), generator=draw)) for n in (4, 2))
        given = Cubes(*(_turned(x, turn, mirror) for x in cubes.some(chosen)))
        goal = _turned(goals[chosen], turn, mirror)
        loss = completion_loss(net(given), goal, p.nodes)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 1.0)
        optimiser.step()
        recent.append(loss.detach())
        if told and ((step + 1) % _TOLD == 0 or step + 1 == p.completion_steps):
            told(step + 1, float(torch.stack(recent[-_TOLD:]).mean()))
    return float(torch.stack(recent[-max(1, p.completion_steps // 10) :]).mean())


def completion_loss(found: torch.Tensor, goal: torch.Tensor, nodes: int) -> torch.Tensor:
    """Of signed distances found and true, both in half sides, (N, n, n, n)."""
    far = (goal >= _REACH) & (found >= _REACH)
    weight = (1 / (_CLOSE + goal.abs())).masked_fill(far, 0.0)
    cell = 2 / nodes
    side = functional.binary_cross_entropy_with_logits(-found / cell, (goal < 0).to(goal), weight=weight)
    return (weight * (found - goal).abs()).mean() + 0.1 * side


def _turned(x: torch.Tensor, turn: int, mirror: int) -> torch.Tensor:
    """Cubes (..., n, n, n) turned about their third axis and mirrored; numbers of cubes (N,) as they are."""
    if x.dim() < 3:
        return x
    x = x.rot90(turn, (-3, -2))
    return x.flip(-3) if mirror else x

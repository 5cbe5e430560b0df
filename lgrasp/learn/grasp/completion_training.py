"""Training of the completing network on views of solids whose distances are known."""

from collections.abc import Sequence

import torch
from torch.nn import functional
from torch.nn.utils import convert_conv3d_weight_memory_format

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.learn.curve import LossCurve
from lgrasp.learn.grasp.completion import SHARES, CompletionNet, Cubes, cubes_of, unit_nodes
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.grasp.solids import SeenSolid
from lgrasp.learn.grasp.views import CloudView
from lgrasp.learn.loop import Descent, Training, falling_rate
from lgrasp.object.sdf import SdfGrid

_TOLD = 20  # steps between two looks at the loss
_REACH = 0.5  # distances beyond this share of half a side are not told apart
_CLOSE = 0.05  # share of half a side at which errors count half as much as at the surface
_WARM = 50  # steps in which the learning rate rises
_AT_ONCE = 16  # views


class ViewSet:
    """Views of O objects with known distances, V of each one after another, on one device."""

    def __init__(self, views: Sequence[CloudView], grids: Sequence[SdfGrid], device: torch.device | str) -> None:
        def put(name: str) -> torch.Tensor:
            parts = [torch.as_tensor(getattr(view, name), dtype=torch.float32) for view in views]
            return torch.stack(parts).to(device)

        self.points, self.normals, self.R, self.t = (put(name) for name in CloudView._fields)
        self.grids = DistanceGrids(grids, device=device)
        self.each = len(views) // len(grids)

    def cubes(self, count: int) -> tuple[Cubes, torch.Tensor]:
        """What the network is given of all views, and the objects' signed distances in half sides, (N, n, n, n); in
        half precision, as they take much memory."""
        nodes, parts = unit_nodes(count, self.points.device), []
        for some in torch.arange(len(self.points), device=self.points.device).split(_AT_ONCE):
            cubes = cubes_of(self.points[some], self.normals[some], count)
            h = cubes.half[:, None, None]
            at = (nodes * h) @ self.R[some].mT + self.t[some, None]
            goal = self.grids.value(at, (some // self.each)[:, None]) / h[..., 0]
            found = *cubes, goal.clamp(-_REACH, _REACH).reshape(cubes.base.shape)
            parts.append([x.half() for x in found])
        half, values, base, goal = (torch.cat(x) for x in zip(*parts, strict=True))
        return Cubes(half, values, base), goal


def solid_views(solids: Sequence[SeenSolid], device: torch.device | str) -> ViewSet:
    """All views of some solids."""
    return ViewSet([view for solid in solids for view in solid.views], [solid.grid for solid in solids], device)


def fit_completion(net: CompletionNet, views: ViewSet, p: GraspParams, training: Training) -> LossCurve:
    """Train a network in place, as phase ``completion`` of a training; the loss along it.

    Cubes are turned by right angles about z and mirrored at random.
    """
    cubes, goals = views.cubes(p.nodes)
    convert_conv3d_weight_memory_format(net.train(), torch.channels_last_3d)
    optimiser = torch.optim.AdamW(net.parameters(), lr=p.completion_rate, weight_decay=1e-4)
    draw, curve = torch.Generator().manual_seed(p.seed), LossCurve(p.completion_steps)

    def loss(_: int) -> tuple[torch.Tensor, torch.Tensor]:
        chosen = torch.randint(len(goals), (p.completion_batch,), generator=draw).to(goals.device)
        turn, mirror = (int(torch.randint(n, (), generator=draw)) for n in (4, 2))
        given = Cubes(*(_turned(x, turn, mirror) for x in cubes.some(chosen)))
        goal = _turned(goals[chosen].float(), turn, mirror)
        found = completion_loss(net(given), goal, p.nodes)
        return found, found

    descent = Descent(optimiser, falling_rate(optimiser, p.completion_steps, _WARM), clip=1.0)
    parts = {"net": net, "random": draw}
    training.run("completion", p.completion_steps, descent, loss, parts=parts, every=_TOLD, curve=curve)
    convert_conv3d_weight_memory_format(net.eval(), torch.contiguous_format)
    return curve


def completion_loss(found: torch.Tensor, goal: torch.Tensor, nodes: int) -> torch.Tensor:
    """Of signed distances found (N, 3, n, n, n) and true (N, n, n, n), in half sides.

    Errors of distances count most where the surface is guessed, too much or too little by the share of each surface;
    so does how sure the network is of the wrong side of it.
    """
    share = torch.tensor(SHARES, device=goal.device)[:, None, None, None]
    goal = goal[:, None].expand_as(found)
    far = (goal >= _REACH) & (found >= _REACH)
    weight = (1 / (_CLOSE + found.detach().abs())).masked_fill(far, 0.0)
    error, inside = goal - found, goal < 0
    pinball = 2 * weight * torch.maximum(share * error, (share - 1) * error)
    logits, sure = -found * nodes / 2, 2 * weight * torch.where(inside, 1 - share, share)
    return pinball.mean() + 0.1 * functional.binary_cross_entropy_with_logits(logits, inside.float(), weight=sure)


def _turned(x: torch.Tensor, turn: int, mirror: int) -> torch.Tensor:
    """Cubes (..., n, n, n) turned about their third axis and mirrored; numbers of cubes (N,) as they are."""
    if x.dim() < 3:
        return x
    x = x.rot90(turn, (-3, -2))
    return x.flip(-3) if mirror else x

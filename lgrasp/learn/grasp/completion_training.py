"""Training of the completing network on views of solids whose distances are known."""

from collections.abc import Callable, Sequence
from functools import cache

import torch
from torch.nn import functional
from torch.nn.utils import convert_conv3d_weight_memory_format

from lgrasp.differentiable.distance import DistanceGrids
from lgrasp.learn.curve import LossCurve
from lgrasp.learn.grasp.completion import SHARES, CompletionNet, Cubes, cubes_of, unit_nodes
from lgrasp.learn.grasp.params import GraspParams
from lgrasp.learn.grasp.solids import SeenSolid
from lgrasp.learn.grasp.views import CloudView
from lgrasp.learn.loop import GradientStep, Training, falling_rate
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

    def cubes(self, count: int, made: Callable[[int], None] = lambda views: None) -> tuple[Cubes, torch.Tensor]:
        """Cubes about all views, and the objects' signed distances in half sides, (N, n, n, n); in half precision, as
        they take much memory. ``made`` is told how many there are."""
        nodes, n = unit_nodes(count, self.points.device), len(self.points)

        def room(*shape: int) -> torch.Tensor:
            return torch.empty(n, *shape, dtype=torch.half, device=self.points.device)

        grid = count, count, count
        cubes_out, goals_out = Cubes(room(), room(*grid), room(*grid), room()), room(*grid)
        for some in torch.arange(n, device=self.points.device).split(_AT_ONCE):
            cubes = cubes_of(self.points[some], self.normals[some], count)
            h = cubes.half[:, None, None]
            at = (nodes * h) @ self.R[some].mT + self.t[some, None]
            goal = self.grids.value(at, (some // self.each)[:, None]) / h[..., 0]
            goals_out[some] = goal.clamp(-_REACH, _REACH).reshape(cubes.base.shape).half()
            for out, found in zip(cubes_out, cubes, strict=True):
                out[some] = found.half()
            made(int(some[-1]) + 1)
        return cubes_out, goals_out


def solid_views(solids: Sequence[SeenSolid], device: torch.device | str) -> ViewSet:
    """All views of some solids."""
    return ViewSet([view for solid in solids for view in solid.views], [solid.grid for solid in solids], device)


def fit_completion(
    net: CompletionNet,
    examples: Callable[[], tuple[Cubes, torch.Tensor]],
    p: GraspParams,
    training: Training,
) -> LossCurve:
    """Train a network in place, as phase ``completion`` of a training; the loss along it. ``examples`` are
    :meth:`ViewSet.cubes`, made if a step is left.

    Cubes are turned by right angles about z and mirrored at random.
    """
    given = cache(examples)
    convert_conv3d_weight_memory_format(net.train(), torch.channels_last_3d)
    optimiser = torch.optim.AdamW(net.parameters(), lr=p.completion_rate, weight_decay=1e-4)
    draw, curve = torch.Generator().manual_seed(p.seed), LossCurve(p.completion_steps)

    def loss(_: int) -> tuple[torch.Tensor, torch.Tensor]:
        cubes, goals = given()
        chosen = torch.randint(len(goals), (p.completion_batch,), generator=draw).to(goals.device)
        turn, mirror = (int(torch.randint(n, (), generator=draw)) for n in (4, 2))
        turned = Cubes(*(_turned(x, turn, mirror) for x in cubes.some(chosen)))
        goal = _turned(goals[chosen].float(), turn, mirror)
        found = completion_loss(net(turned), goal, p.nodes)
        return found, found

    gradient_step = GradientStep(optimiser, falling_rate(optimiser, p.completion_steps, _WARM), clip=1.0)
    parts = {"net": net, "random": draw}
    training.run("completion", p.completion_steps, gradient_step, loss, parts=parts, every=_TOLD, curve=curve)
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

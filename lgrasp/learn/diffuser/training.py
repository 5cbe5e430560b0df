"""Training of the sampler of steps: the data stays on the device, batches are drawn there."""

import copy
import math
from collections.abc import Callable
from typing import Any

import torch

from lgrasp.learn.curve import add_point
from lgrasp.learn.diffuser.examples import StepExamples, split_steps
from lgrasp.learn.diffuser.network import DiffuserNet, Situation
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.diffuser.process import PROCESSES, Process

_TOLD = 50  # steps between two looks at the loss: each look waits for the device
_LOOKS = 40  # at what is learnt, for the curve
_WARM = 200  # steps in which the learning rate rises
_EVALUATED, _LOOKED_AT = 16_384, 2048  # steps of sequences at most: after the training, for the curve


class StepTrainer:
    """A network, the mean of its weights that is kept, and the random numbers of one training, without ``unseen``
    objects (O,) bool, which are only evaluated on."""

    def __init__(
        self,
        net: DiffuserNet,
        examples: StepExamples,
        unseen: torch.Tensor,
        params: DiffuserParams,
        device: str | torch.device = "cpu",
    ) -> None:
        self.params, self.device, self.examples = params, torch.device(device), examples
        self.net = net.to(self.device)
        self.net.mean, self.net.spread = examples.statistics()
        self.kept = copy.deepcopy(self.net).requires_grad_(False).eval()
        self.process = PROCESSES[params.process]
        self.rows, self.unseen_rows = split_steps(examples.steps.object, examples.steps.held, unseen.to(self.device))
        self._random = torch.Generator(self.device).manual_seed(params.seed)

    def fit(self, told: Callable[[int, float], None] | None = None) -> dict[str, list[list[float]]]:
        """All steps of the training; ``told`` is called with (step, mean loss since the last call) now and then.

        Returns:
            Loss of the kept weights on objects that are trained on and on ``unseen`` ones, along the training.
        """
        curves: dict[str, list[list[float]]] = {"loss": [], "unseen": []}
        with torch.random.fork_rng():
            torch.manual_seed(self.params.seed)  # of dropout
            self._fit(told, curves)
        return {name: points for name, points in curves.items() if points}

    def _fit(self, told: Callable[[int, float], None] | None, curves: dict[str, list[list[float]]]) -> None:
        p, weights = self.params, list(self.net.parameters())
        optimiser = torch.optim.AdamW(weights, lr=p.rate, weight_decay=p.decay, fused=self.device.type == "cuda")
        rate = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _share(step, p.steps))
        total, counted = torch.zeros((), device=self.device), 0
        for step in range(p.steps):
            picked = torch.randint(len(self.rows), (p.batch,), generator=self._random, device=self.device)
            loss = _loss(self.net, self.examples, self.rows[picked], self.process, self._random, self._blinded)
            optimiser.zero_grad()
            loss.backward()
            torch.nn.utils.clip_grad_norm_(weights, 1.0)
            optimiser.step()
            rate.step()
            with torch.no_grad():
                # a young mean forgets the random weights soon
                decay = min(p.average, (1 + step) / (10 + step))
                for kept, new in zip(self.kept.parameters(), weights, strict=True):
                    kept.lerp_(new, 1 - decay)
            total, counted = total + loss.detach(), counted + 1
            if told and ((step + 1) % _TOLD == 0 or step + 1 == p.steps):
                told(step + 1, float(total) / counted)
                total, counted = torch.zeros((), device=self.device), 0
            if (step + 1) % math.ceil(p.steps / _LOOKS) == 0 or step + 1 == p.steps:
                for points, rows in zip(curves.values(), (self.rows, self.unseen_rows), strict=True):
                    if len(rows):
                        found = mean_loss(self.kept, self.examples, rows, self.process, most=_LOOKED_AT)
                        add_point(points, step + 1, found)

    def losses(self) -> tuple[float, float]:
        """Loss of the kept weights on steps that it was trained on, and on those of unseen objects (NaN of none)."""
        seen, unseen = (
            mean_loss(self.kept, self.examples, rows, self.process) for rows in (self.rows, self.unseen_rows)
        )
        return seen, unseen

    def _blinded(self, s: Situation) -> Situation:
        """Situations of which some do not see the object to grasp, which the hand only feels then."""
        seen = torch.rand(len(s.shape), 1, generator=self._random, device=self.device) >= self.params.blind
        return s._replace(shape=s.shape * seen)


@torch.no_grad()
def mean_loss(
    net: DiffuserNet, examples: StepExamples, rows: torch.Tensor, process: Process, *, most: int = _EVALUATED
) -> float:
    """Loss on some of the steps, ``most`` at most; NaN of none."""
    draw = torch.Generator(rows.device).manual_seed(1)
    rows = rows[torch.randperm(len(rows), generator=draw, device=rows.device)[:most]]
    parts = [_loss(net, examples, part, process, draw) * len(part) for part in rows.split(4096)]
    return float(sum(parts)) / len(rows) if len(rows) else float("nan")


def _loss(
    net: DiffuserNet,
    examples: StepExamples,
    rows: torch.Tensor,
    process: Process,
    draw: torch.Generator,
    change: Callable[[Situation], Situation] = lambda situation: situation,
) -> torch.Tensor:
    """Mean square of the error of dx/dt over entries that move."""
    n = len(rows)
    like: dict[str, Any] = {"generator": draw, "device": rows.device}
    way = torch.randint(examples.ways, (n,), **like)
    goal, situation = examples.batch(rows, way)
    situation = change(situation)
    x = net.standardised(*goal)
    t = process.times(torch.rand(n, 1, **like))
    mixed, velocity = process.mix(x, torch.randn(x.shape, **like), t)
    moving = net.moving(situation.free)
    mixed = mixed * moving
    felt = examples.felt(rows, way, net.noisy_steps(mixed, process.coefficients(t)[0], situation))
    error = (net(mixed, t, net.situation(situation), felt) - velocity) * moving
    return (error**2).sum() / moving.sum()


def _share(step: int, steps: int) -> float:
    """Share of the learning rate: it rises, then falls like a cosine."""
    return min(1.0, (step + 1) / _WARM) * 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))

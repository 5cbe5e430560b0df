"""Training of the sampler of steps: the data stays on the device, batches are drawn there."""

import copy
import math
from collections.abc import Callable

import torch

from lgrasp.learn.diffuser.examples import StepExamples
from lgrasp.learn.diffuser.network import DiffuserNet
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.diffuser.process import PROCESSES

_TOLD = 50  # steps between two looks at the loss: each look waits for the device
_WARM = 200  # steps in which the learning rate rises
_EVALUATED = 16_384  # steps of sequences at most


class StepTrainer:
    """A network, the mean of its weights that is kept, and the random numbers of one training."""

    def __init__(
        self, net: DiffuserNet, examples: StepExamples, params: DiffuserParams, device: str | torch.device = "cpu"
    ) -> None:
        self.params, self.device, self.examples = params, torch.device(device), examples
        self.net = net.to(self.device)
        self.net.mean, self.net.spread = examples.statistics()
        self.kept = copy.deepcopy(self.net).requires_grad_(False)
        self.process = PROCESSES[params.process]
        order = torch.randperm(len(examples), generator=torch.Generator().manual_seed(params.seed))
        out = int(params.held_out * len(examples))
        self._held_out, self._rows = (part.to(self.device) for part in (order[:out], order[out:]))
        self._random = torch.Generator(self.device).manual_seed(params.seed)

    def fit(self, told: Callable[[int, float], None] | None = None) -> None:
        """All steps of the training; ``told`` is called with (step, mean loss since the last call) now and then."""
        p, weights = self.params, list(self.net.parameters())
        optimiser = torch.optim.AdamW(weights, lr=p.rate, weight_decay=1e-4, fused=self.device.type == "cuda")
        rate = torch.optim.lr_scheduler.LambdaLR(optimiser, lambda step: _share(step, p.steps))
        total, counted = torch.zeros((), device=self.device), 0
        for step in range(p.steps):
            picked = torch.randint(len(self._rows), (p.batch,), generator=self._random, device=self.device)
            loss = self._loss(self.net, self._rows[picked], self._random)
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

    @torch.no_grad()
    def losses(self) -> tuple[float, float]:
        """Loss of the kept weights on steps that it was trained on, and on those that were held out (NaN of none)."""
        found = []
        for rows in (self._rows, self._held_out):
            rows = rows[:_EVALUATED]
            draw = torch.Generator(self.device).manual_seed(1)
            parts = [self._loss(self.kept, part, draw) * len(part) for part in rows.split(4096)]
            found.append(float(sum(parts)) / len(rows) if len(rows) else float("nan"))
        return found[0], found[1]

    def _loss(self, net: DiffuserNet, rows: torch.Tensor, draw: torch.Generator) -> torch.Tensor:
        """Mean square of the error of dx/dt over entries that move."""
        n = len(rows)
        turn = torch.randint(len(self.examples.turns), (n,), generator=draw, device=self.device)
        goal, situation = self.examples.batch(rows, turn)
        x = net.standardised(*goal)
        t = self.process.times(torch.rand(n, 1, generator=draw, device=self.device))
        noise = torch.randn(x.shape, generator=draw, device=self.device)
        mixed, velocity = self.process.mix(x, noise, t)
        moving = net.moving(situation.free)
        mixed = mixed * moving
        felt = self.examples.felt(rows, turn, net.noisy_steps(mixed, self.process.coefficients(t)[0], situation))
        error = (net(mixed, t, net.situation(situation), felt) - velocity) * moving
        return (error**2).sum() / moving.sum()


def _share(step: int, steps: int) -> float:
    """Share of the learning rate: it rises, then falls like a cosine."""
    return min(1.0, (step + 1) / _WARM) * 0.5 * (1 + math.cos(math.pi * min(step / steps, 1.0)))

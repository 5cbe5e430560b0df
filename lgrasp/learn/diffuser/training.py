"""Training of the sampler of steps: the data stays on the device, batches are drawn there."""

import copy
import math
from collections.abc import Callable
from typing import Any

import torch

from lgrasp.learn.curve import LossCurve
from lgrasp.learn.diffuser.examples import StepExamples, split_steps
from lgrasp.learn.diffuser.network import DiffuserNet, Situation
from lgrasp.learn.diffuser.params import DiffuserParams
from lgrasp.learn.diffuser.process import PROCESSES, Process
from lgrasp.learn.loop import GradientStep, Training, falling_rate

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

    def fit(self, training: Training, phase: str = "drawing") -> dict[str, list[list[float]]]:
        """All steps, as a phase of a training.

        Returns:
            Loss of the kept weights on objects that are trained on and on ``unseen`` ones, along the training.
        """
        p, weights = self.params, list(self.net.parameters())
        optimiser = torch.optim.AdamW(weights, lr=p.rate, weight_decay=p.decay, fused=self.device.type == "cuda")
        gradient_step = GradientStep(optimiser, falling_rate(optimiser, p.steps, _WARM), clip=1.0)
        curves = {name: LossCurve(p.steps) for name in ("loss", "unseen")}

        def loss(_: int) -> tuple[torch.Tensor, torch.Tensor]:
            picked = torch.randint(len(self.rows), (p.batch,), generator=self._random, device=self.device)
            found = _loss(self.net, self.examples, self.rows[picked], self.process, self._random, self._blinded)
            return found, found

        def after(done: int) -> None:
            with torch.no_grad():
                decay = min(p.average, done / (9 + done))  # a young mean forgets the random weights soon
                for kept, new in zip(self.kept.parameters(), weights, strict=True):
                    kept.lerp_(new, 1 - decay)
            if done % math.ceil(p.steps / _LOOKS) == 0 or done == p.steps:
                for curve, rows in zip(curves.values(), (self.rows, self.unseen_rows), strict=True):
                    if len(rows):
                        curve(done, mean_loss(self.kept, self.examples, rows, self.process, most=_LOOKED_AT))

        parts = {"net": self.net, "kept": self.kept, "random": self._random, **curves}
        with torch.random.fork_rng():
            torch.manual_seed(p.seed)  # of dropout
            training.run(phase, p.steps, gradient_step, loss, parts=parts, every=_TOLD, after=after)
        return {name: curve.points for name, curve in curves.items() if curve.points}

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

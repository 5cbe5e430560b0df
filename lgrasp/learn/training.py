"""Training of the coarse predictor, on poses alone, then jointly through unrolled steps of the refiner; its quality."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch.nn import functional

from lgrasp.hand.model import HandModel
from lgrasp.learn.curve import LossCurve
from lgrasp.learn.examples import Examples
from lgrasp.learn.loop import GradientStep, Training
from lgrasp.learn.network import Coarse, CoarseNet, best_answers
from lgrasp.learn.params import LearnParams
from lgrasp.refine.refiner import Pose, Refiner

ANSWERS = 4
"""Of each cloud that are measured, the best ones."""
_ANY_REACH = 10.0  # [m]


_Batch = tuple[torch.Tensor, torch.Tensor, torch.Tensor]
"""Points (N, n, 3) and normals (N, n, 3) of clouds of one object, and a seed on each (N,)."""


def pose_loss(coarse: Coarse, points: torch.Tensor, examples: Examples, params: LearnParams) -> torch.Tensor:
    """How far answers are from the grasps of their seeds, and scores from whether there are any; a number.

    Of the ``choices`` grasps whose palm points are nearest to a seed the one that is closest to the answer counts:
    where a place can be grasped in several ways, one of them is learnt and not their mean.

    Args:
        points: the seeds themselves [m], (N, 3).
    """
    away = torch.cdist(points, examples.anchor)  # (N, G)
    gap, near = away.topk(min(params.choices, away.shape[1]), largest=False)
    turn = ((coarse.R[:, None] - examples.R[near]) ** 2).sum((-1, -2))
    shift = ((coarse.t[:, None] - examples.t[near]) ** 2).sum(-1) / params.scale**2
    bend = ((coarse.q[:, None] - examples.q[near]) ** 2).mean(-1)
    apart = torch.where(gap <= params.near, turn + shift + bend, torch.inf).amin(1)
    there = torch.isfinite(apart)
    score = functional.binary_cross_entropy_with_logits(coarse.score, there.to(coarse.score))
    return torch.where(there, apart, 0.0).sum() / there.sum().clamp_min(1) + 0.1 * score


def whole_energy(refiner: Refiner, pose: Pose) -> torch.Tensor:
    """E* of hands with palmar points pulling however far off they are, (N,): far hands have no low energy."""
    return refiner.energy(*pose, matches=refiner.match(*pose, reach=_ANY_REACH)).total


class Trainer:
    """A predictor, a refiner for each object, and the random numbers of one training."""

    def __init__(
        self,
        hand: HandModel,
        train: Sequence[Examples],
        params: LearnParams,
        *,
        device: str | torch.device = "cpu",
    ) -> None:
        self.params, self.device = params, torch.device(device)
        self._hand, self._train = hand, [_moved(e, self.device) for e in train]
        self._random = torch.Generator().manual_seed(params.seed)
        self._refiners: dict[int, Refiner] = {}
        state = torch.random.get_rng_state()
        torch.manual_seed(params.seed)
        lower, upper = (torch.as_tensor(x, dtype=torch.float32) for x in (hand.tree.joint_lower, hand.tree.joint_upper))
        self.net = CoarseNet(lower, upper, params).to(self.device)
        torch.random.set_rng_state(state)

    def fit_poses(self, training: Training, phase: str, steps: int, rate: float) -> LossCurve:
        """Steps on poses alone, as a phase of a training, the learning rate falling to a tenth; the loss along them."""
        optimiser = torch.optim.Adam(self.net.parameters(), lr=rate)
        fall = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, max(steps, 1), 0.1 * rate)

        def loss(step: int) -> tuple[torch.Tensor, torch.Tensor]:
            examples = self._train[step % len(self._train)]
            found = self._pose_loss(self._draw(examples), examples)
            return found, found

        return self._run(training, phase, steps, GradientStep(optimiser, fall), loss, "loss")

    def fit_jointly(self, training: Training) -> LossCurve:
        """``joint_steps`` steps on the energy after K unrolled steps of the refiner, phase ``joint`` of a training; the
        mean energy along them.

        The loss is the mean of log(1 + E*), so that a few hopeless answers do not drown the others, and
        ``pose_weight`` times the loss on poses.
        """
        p = self.params

        def loss(step: int) -> tuple[torch.Tensor, torch.Tensor]:
            examples = self._train[step % len(self._train)]
            batch = self._draw(examples)
            refiner = self.refiner(examples)
            pose = refiner.unrolled(*self.net(*batch)[:3], steps=p.unrolled)
            total = whole_energy(refiner, pose)
            found = total.clamp_min(0).log1p().mean()
            if p.pose_weight:
                found = found + p.pose_weight * self._pose_loss(batch, examples)
            return found, total.mean()

        gradient_step = GradientStep(torch.optim.Adam(self.net.parameters(), lr=p.joint_rate), clip=1.0)
        return self._run(training, "joint", p.joint_steps, gradient_step, loss, "energy")

    def _run(
        self,
        training: Training,
        phase: str,
        steps: int,
        gradient_step: GradientStep,
        loss: Callable[[int], tuple[torch.Tensor, torch.Tensor]],
        name: str,
    ) -> LossCurve:
        curve = LossCurve(steps, turn=len(self._train))
        parts = {"net": self.net, "random": self._random}
        training.run(phase, steps, gradient_step, loss, parts=parts, name=name, curve=curve)
        return curve

    def refiner(self, examples: Examples) -> Refiner:
        """The refiner of an object."""
        key = id(examples.model)
        if key not in self._refiners:
            self._refiners[key] = Refiner(self._hand, examples.model, device=self.device)
        return self._refiners[key]

    @torch.no_grad()
    def predict(self, examples: Examples, answers: int) -> Coarse:
        """The best ``answers`` answers for every cloud."""
        clouds = zip(*_moved(examples, self.device)[1:3], strict=True)
        parts = [best_answers(self.net, points, normals, answers) for points, normals in clouds]
        return Coarse(*(torch.cat(x) for x in zip(*parts, strict=True)))

    def _pose_loss(self, batch: _Batch, examples: Examples) -> torch.Tensor:
        points, _, seeds = batch
        here = points[torch.arange(len(seeds), device=self.device), seeds]
        return pose_loss(self.net(*batch), here, examples, self.params)

    def _draw(self, examples: Examples) -> _Batch:
        clouds, n = examples.points.shape[:2]
        drawn = (torch.randint(most, (self.params.batch,), generator=self._random) for most in (clouds, n))
        which, seeds = (numbers.to(self.device) for numbers in drawn)
        return examples.points[which], examples.normals[which], seeds


def _moved(e: Examples, device: torch.device) -> Examples:
    return Examples(e.model, *(x.to(device) for x in e[1:]))


class Measured(NamedTuple):
    """Means over all answers that were measured."""

    poses: int
    coarse: float
    """E* of the answers."""
    unrolled: float
    """E* after the K unrolled steps of joint training."""
    refined: tuple[float, ...]
    """E* after each number of rounds that was asked for."""


def measure(trainer: Trainer, examples: Sequence[Examples], *, rounds: Sequence[int] = ()) -> Measured:
    """Energies of the best answers for clouds, and after so many ``rounds`` of the refiner."""
    parts: list[torch.Tensor] = []
    for e in examples:
        coarse, refiner = trainer.predict(e, ANSWERS), trainer.refiner(e)
        start = Pose(*coarse[:3])
        poses = [start, Pose(*(x.detach() for x in refiner.unrolled(*start, steps=trainer.params.unrolled)))]
        poses += [refiner(*start, rounds=steps).pose for steps in rounds]
        with torch.no_grad():
            parts.append(torch.stack([whole_energy(refiner, pose) for pose in poses]))
    every = torch.cat(parts, 1)  # (2 + rounds, N)
    coarse, unrolled, *refined = every.mean(1).tolist()
    return Measured(every.shape[1], coarse, unrolled, tuple(refined))

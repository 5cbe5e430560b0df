"""The networks of a pose policy in torch, and their training."""

import math
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.learn.curve import LossCurve
from lgrasp.learn.loop import GradientStep, Training
from lgrasp.learn.params import PosePolicyParams
from lgrasp.policy.model import HIT_FEATURES, MOST_HITS, WIDTH, Weights
from lgrasp.policy.score import (
    CENTRE_SCALE,
    COUNT_SCALE,
    DISTANCE_RANGE,
    DISTANCE_SCALE,
    HIT_SCALE,
    MOMENT_SCALE,
)

_DROPOUT = 0.1


class Seen(NamedTuple):
    """What a network is told of N poses of a hand with G groups; base frame, K = MOST_HITS."""

    hits: np.ndarray
    """Points and normals of contacts, (N, G, K, 6) [m]."""
    count: np.ndarray
    """How many there are, (N, G)."""
    share: np.ndarray
    """(N, G) as the kernels tell it."""
    com: np.ndarray
    """Centre of mass [m], (N, 3)."""
    palm: np.ndarray
    """Whether the palm touches, (N,)."""
    distances: np.ndarray
    """Of the object at the policy's points [m], (N, M)."""


def join_seen(parts: list[Seen]) -> Seen:
    """Several, one after another."""
    return Seen(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


class PoseNet(torch.nn.Module):
    """Log-odds that a pose gives a grasp: the contacts of each group are pooled, and two layers follow."""

    def __init__(self, groups: int, points: int) -> None:
        super().__init__()
        self.hit = torch.nn.Linear(HIT_FEATURES, WIDTH)
        self.first = torch.nn.Linear(2 * WIDTH * groups + 4 + groups + points, WIDTH)
        self.second = torch.nn.Linear(WIDTH, WIDTH)
        self.last = torch.nn.Linear(WIDTH, 1)
        self.drop = torch.nn.Dropout(_DROPOUT)

    def forward(self, hits: torch.Tensor, used: torch.Tensor, extras: torch.Tensor) -> torch.Tensor:
        """(N,) from hit features (N, G, K, 9), which of them are used (N, G, K) and extras (N, E)."""
        x = torch.relu(self.hit(hits)) * used[..., None]
        mean = x.sum(2) / used.sum(2, keepdim=True).clamp_min(1.0)
        pooled = torch.cat([mean, x.amax(2)], 2).flatten(1)
        h = self.drop(torch.relu(self.first(torch.cat([pooled, extras], 1))))
        return self.last(self.drop(torch.relu(self.second(h))))[:, 0]

    def weights(self) -> Weights:
        """The rows that kernels read."""
        rows = [part for layer in (self.hit, self.first, self.second) for part in (layer.weight.T, layer.bias[None])]
        end = torch.zeros(2, WIDTH)
        end[0], end[1, 0] = self.last.weight[0], self.last.bias[0]
        return Weights(torch.cat([*rows, end]).detach().cpu().numpy().astype(np.float32))


def inputs_of(seen: Seen) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """What the network takes."""
    p, n = seen.hits[..., :3] - seen.com[:, None, None], seen.hits[..., 3:]
    used = np.arange(MOST_HITS) < seen.count[..., None]
    hits = np.concatenate([p * HIT_SCALE, n, np.cross(p, n) * MOMENT_SCALE], 3) * used[..., None]
    distances = np.clip(seen.distances * DISTANCE_SCALE, *DISTANCE_RANGE)
    extras = [seen.com * CENTRE_SCALE, seen.palm[:, None], np.log1p(COUNT_SCALE * seen.share), distances]
    made = (hits, used, np.concatenate(extras, 1))
    hits, used, extras = (torch.from_numpy(np.ascontiguousarray(a, np.float32)) for a in made)
    return hits, used, extras


def fit_network(
    seen: Seen, yields: np.ndarray, params: PosePolicyParams, training: Training, phase: str
) -> tuple[PoseNet, dict[str, list[list[float]]]]:
    """A network of poses and whether they gave a grasp, (N,), and its loss along this phase of a training.

    Where only the share ``params.failures`` of the poses without a grasp is given, the odds count the others too.
    """
    inputs, wanted = inputs_of(seen), torch.from_numpy(yields.astype(np.float32))
    steps = max(1, params.epochs * len(wanted) // params.batch)
    curve = LossCurve(steps)

    def loss(_: int) -> tuple[torch.Tensor, torch.Tensor]:
        rows = torch.randint(len(wanted), (params.batch,))
        found = torch.nn.functional.binary_cross_entropy_with_logits(net(*(a[rows] for a in inputs)), wanted[rows])
        return found, found

    with torch.random.fork_rng([]):
        torch.manual_seed(params.seed)
        net = PoseNet(seen.hits.shape[1], seen.distances.shape[1])
        optimiser = torch.optim.AdamW(net.parameters(), lr=params.rate, weight_decay=params.decay)
        rate = torch.optim.lr_scheduler.OneCycleLR(optimiser, params.rate, total_steps=steps + 1)
        training.run(phase, steps, GradientStep(optimiser, rate), loss, parts={"net": net}, curve=curve)
    with torch.no_grad():
        net.last.bias.add_(math.log(params.failures))
    return net.eval(), {"loss": curve.points}


@torch.no_grad()
def rate(net: PoseNet, seen: Seen) -> np.ndarray:
    """Log-odds, (N,)."""
    return net(*inputs_of(seen)).cpu().numpy()


def ranking(score: np.ndarray, yields: np.ndarray) -> float | None:
    """Share of pairs of a pose that gave a grasp and one that did not in which the first has the higher score; None
    where there is no pair."""
    good, bad = score[yields], np.sort(score[~yields])
    if not len(good) or not len(bad):
        return None
    below = np.searchsorted(bad, good, "left") + np.searchsorted(bad, good, "right")
    return float(below.mean() / (2 * len(bad)))

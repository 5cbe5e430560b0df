"""Steps of the local search: down the gradient, per sample, never larger than the parameters say."""

from typing import NamedTuple

import torch

from lgrasp.refine.params import LocalSearch

__all__ = ["Gradient", "Moments", "clipped"]

_TINY = 1e-12
_SECOND = 0.99  # decay of adam's second moment


class Gradient(NamedTuple):
    """Of the total energy by motions of the base about the hand's middle and by the joints."""

    shift: torch.Tensor  # (N, 3)
    turn: torch.Tensor  # (N, 3)
    bend: torch.Tensor  # (N, K)


def clipped(g: Gradient, p: LocalSearch) -> Gradient:
    """A step down, at most the parameters' sizes, per sample."""

    def down(x: torch.Tensor, size: float) -> torch.Tensor:
        scaled = x * size
        return -size * scaled / (1 + (scaled * scaled).sum(-1, keepdim=True)).sqrt()

    return Gradient(down(g.shift, p.shift), down(g.turn, p.turn), down(g.bend, p.bend))


class Moments:
    """Running means of gradients, per sample and coordinate."""

    def __init__(self, t: torch.Tensor, q: torch.Tensor) -> None:
        zeros = (torch.zeros_like(t), torch.zeros_like(t), torch.zeros_like(q))
        self._first, self._second, self._steps = list(zeros), list(zeros), 0

    def step(self, g: Gradient, p: LocalSearch, size: float) -> Gradient:
        """The step down that adam, or sgd with momentum, takes; ``size``: share of the parameters' sizes."""
        self._steps += 1
        out = []
        for i, (x, most) in enumerate(zip(g, (p.shift, p.turn, p.bend), strict=True)):
            if p.optimizer == "sgd":
                # clipped per sample, then averaged
                x = x / x.norm(dim=-1, keepdim=True).clamp_min(1.0)
                self._first[i] = p.momentum * self._first[i] + (1 - p.momentum) * x
                out.append(-most * size * self._first[i])
                continue
            self._first[i] = p.momentum * self._first[i] + (1 - p.momentum) * x
            # one scale for the three axes: steps do not depend on the frame
            square = x * x if i == 2 else (x * x).mean(-1, keepdim=True).expand_as(x)
            self._second[i] = _SECOND * self._second[i] + (1 - _SECOND) * square
            mean = self._first[i] / (1 - p.momentum**self._steps)
            root = (self._second[i] / (1 - _SECOND**self._steps)).sqrt()
            move = mean / (root + _TINY)
            out.append(-most * size * move.clamp(-1, 1))
        return Gradient(*out)

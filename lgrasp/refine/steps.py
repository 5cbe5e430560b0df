"""Steps of the local search: down the gradient, per sample, never larger than the parameters say."""

from typing import NamedTuple

import torch

from lgrasp.refine.params import LocalSearch


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

"""Steps of the local search: down the gradient, per sample, never larger than the parameters say."""

from typing import NamedTuple

import torch

from lgrasp.refine.params import LocalSearch


class Gradient(NamedTuple):
    """Of the total energy by motions of the base about the hand's middle and by the joints."""

    translation: torch.Tensor  # (N, 3) [1/m]
    rotation: torch.Tensor  # (N, 3) [1/rad]
    joints: torch.Tensor  # (N, K)


def clipped(g: Gradient, p: LocalSearch) -> Gradient:
    """A step down, at most the parameters' sizes, per sample."""

    def down(x: torch.Tensor, size: float) -> torch.Tensor:
        scaled = x * size
        return -size * scaled / (1 + (scaled * scaled).sum(-1, keepdim=True)).sqrt()

    return Gradient(
        down(g.translation, p.max_translation_step),
        down(g.rotation, p.max_rotation_step),
        down(g.joints, p.max_joint_step),
    )

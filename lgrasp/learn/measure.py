"""Quality of coarse answers before and after the refiner: energies against steps."""

from collections.abc import Sequence
from typing import NamedTuple

import torch

from lgrasp.learn.examples import Examples
from lgrasp.learn.training import Trainer, whole_energy
from lgrasp.refine.refiner import Pose


class Measured(NamedTuple):
    """Means over all clouds and seeds that were measured on."""

    poses: int
    coarse: float
    """E* of the answers."""
    unrolled: float
    """E* after the K unrolled steps of joint training."""
    refined: tuple[float, ...]
    """E* after each number of rounds that was asked for."""


def measure(trainer: Trainer, examples: Sequence[Examples], *, seeds: int = 4, rounds: Sequence[int] = ()) -> Measured:
    """Energies of the answers at the same seeds of the same clouds, every time.

    Args:
        seeds: points of each cloud that are asked.
        rounds: numbers of rounds of the refiner.
    """
    parts: list[torch.Tensor] = []
    for e in examples:
        coarse, refiner = trainer.predict(e, seeds), trainer.refiner(e)
        start = Pose(coarse.R, coarse.t, coarse.q)
        poses = [start, Pose(*(x.detach() for x in refiner.unrolled(*start, steps=trainer.params.unrolled)))]
        poses += [refiner(*start, rounds=steps).pose for steps in rounds]
        with torch.no_grad():
            parts.append(torch.stack([whole_energy(refiner, pose) for pose in poses]))
    every = torch.cat(parts, 1)  # (2 + rounds, N)
    coarse, unrolled, *refined = every.mean(1).tolist()
    return Measured(every.shape[1], coarse, unrolled, tuple(refined))

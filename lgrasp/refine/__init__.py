"""Differentiable local search of grasps."""

from lgrasp.refine.energy import Energies, Matches
from lgrasp.refine.params import LocalSearch
from lgrasp.refine.refiner import Pose, Refined, Refiner
from lgrasp.refine.surface import HandSurface, hand_surface
from lgrasp.refine.target import Target

__all__ = [
    "Energies",
    "HandSurface",
    "LocalSearch",
    "Matches",
    "Pose",
    "Refined",
    "Refiner",
    "Target",
    "hand_surface",
]

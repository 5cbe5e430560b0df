"""Differentiable local search of grasps."""

from typing import TYPE_CHECKING, Any

from lgrasp.refine.params import LocalSearch
from lgrasp.refine.surface import HandSurface, hand_surface

if TYPE_CHECKING:
    from lgrasp.refine.energy import Energies, Matches
    from lgrasp.refine.refiner import Pose, Refined, Refiner
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


def __getattr__(name: str) -> Any:
    modules = {"energy": ("Energies", "Matches"), "refiner": ("Pose", "Refined", "Refiner"), "target": ("Target",)}
    for module, names in modules.items():  # they import torch, so only when asked for
        if name in names:
            import importlib

            return getattr(importlib.import_module(f"lgrasp.refine.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""What makes ``import lgrasp as lg`` light: public names are imported when they are first used."""

from importlib import import_module
from types import ModuleType
from typing import Any

HOMES = {
    "lgrasp.api": (
        "Grasps",
        "Hand",
        "Object",
        "generate",
        "hands",
        "load_hand",
        "load_object",
        "objects",
        "open",
        "pipelines",
        "plan",
        "read_cloud",
        "refine",
        "sequence",
        "simulate",
    ),
    "lgrasp.dataset.exports": ("export_shards", "read_grasps"),
    "lgrasp.dataset.merge": ("merge_shards",),
    "lgrasp.dataset.reader": ("ShardReader", "pose_matrix", "read_shard"),
    "lgrasp.dataset.torch_dataset": ("GraspDataset",),
    "lgrasp.dataset.validate": ("validate_shard",),
    "lgrasp.dataset.writer": ("write_shard",),
    "lgrasp.engine.pipeline": ("load_pipeline",),
    "lgrasp.errors": ("LgraspError",),
    "lgrasp.grasp.bounds": ("GraspBounds",),
    "lgrasp.grasp.records": ("Shard",),
    "lgrasp.jobs.learn.job": ("load_predictor",),
    "lgrasp.judge.run": ("judge",),
    "lgrasp.learn.network": ("best_answers",),
    "lgrasp.refine.params": ("LocalSearch",),
    "lgrasp.refine.refiner": ("Refiner",),
    "lgrasp.scenes.reader": ("SceneReader", "read_scene"),
}
"""Module of every public name."""

_HOME = {name: module for module, names in HOMES.items() for name in names}


class Face(ModuleType):
    """The package as a module. A public function keeps its name where a room has the same: ``lgrasp.simulate`` is the
    function, ``import lgrasp.simulate.run`` works as ever."""

    def __getattr__(self, name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module 'lgrasp' has no attribute {name!r}; it has {', '.join(sorted(_HOME))}")
        value = getattr(import_module(_HOME[name]), name)
        super().__setattr__(name, value)
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *_HOME})

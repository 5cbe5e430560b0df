"""lgrasp: a fast, trustworthy, open generator of dexterous-hand grasps. ``import lgrasp as lg`` loads nothing heavy."""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lgrasp.api import (
        Grasps,
        Hand,
        Object,
        generate,
        hands,
        load,
        load_hand,
        load_object,
        objects,
        open,
        pipelines,
        plan,
        read_cloud,
        refine,
        sequence,
        simulate,
    )
    from lgrasp.dataset.exports.formats import export_shards, read_grasps
    from lgrasp.dataset.merge import merge_shards
    from lgrasp.dataset.normalisation import Normalisation
    from lgrasp.dataset.reader import ShardReader, read_shard
    from lgrasp.dataset.torch_dataset import GraspDataset
    from lgrasp.dataset.torch_stream import GraspIterableDataset
    from lgrasp.dataset.validate import validate_shard
    from lgrasp.dataset.writer import write_shard
    from lgrasp.engine.pipeline import load_pipeline
    from lgrasp.errors import LgraspError
    from lgrasp.geometry.poses import pose_matrix
    from lgrasp.grasp.bounds import GraspBounds
    from lgrasp.grasp.records import Shard
    from lgrasp.jobs.learn.job import load_predictor
    from lgrasp.judge.run import judge
    from lgrasp.learn.network import best_answers
    from lgrasp.refine.params import LocalSearch
    from lgrasp.refine.refiner import Refiner
    from lgrasp.scenes.files import SceneReader, read_scene

__version__ = "0.2.0"
__all__ = [
    "GraspBounds",
    "GraspDataset",
    "GraspIterableDataset",
    "Grasps",
    "Hand",
    "LgraspError",
    "LocalSearch",
    "Normalisation",
    "Object",
    "Refiner",
    "SceneReader",
    "Shard",
    "ShardReader",
    "__version__",
    "best_answers",
    "export_shards",
    "generate",
    "hands",
    "judge",
    "load",
    "load_hand",
    "load_object",
    "load_pipeline",
    "load_predictor",
    "merge_shards",
    "objects",
    "open",
    "pipelines",
    "plan",
    "pose_matrix",
    "read_cloud",
    "read_grasps",
    "read_scene",
    "read_shard",
    "refine",
    "sequence",
    "simulate",
    "validate_shard",
    "write_shard",
]

_HOMES = {
    "lgrasp.api": "Grasps Hand Object generate hands load load_hand load_object objects open pipelines plan read_cloud "
    "refine sequence simulate",
    "lgrasp.dataset.exports.formats": "export_shards read_grasps",
    "lgrasp.dataset.merge": "merge_shards",
    "lgrasp.dataset.normalisation": "Normalisation",
    "lgrasp.dataset.reader": "ShardReader read_shard",
    "lgrasp.dataset.torch_dataset": "GraspDataset",
    "lgrasp.dataset.torch_stream": "GraspIterableDataset",
    "lgrasp.dataset.validate": "validate_shard",
    "lgrasp.dataset.writer": "write_shard",
    "lgrasp.engine.pipeline": "load_pipeline",
    "lgrasp.errors": "LgraspError",
    "lgrasp.geometry.poses": "pose_matrix",
    "lgrasp.grasp.bounds": "GraspBounds",
    "lgrasp.grasp.records": "Shard",
    "lgrasp.jobs.learn.job": "load_predictor",
    "lgrasp.judge.run": "judge",
    "lgrasp.learn.network": "best_answers",
    "lgrasp.refine.params": "LocalSearch",
    "lgrasp.refine.refiner": "Refiner",
    "lgrasp.scenes.files": "SceneReader read_scene",
}
_HOME = {name: module for module, names in _HOMES.items() for name in names.split()}
"""Module of every public name."""


class _Face(ModuleType):
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


sys.modules[__name__].__class__ = _Face

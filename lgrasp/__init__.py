"""lgrasp: a fast, trustworthy, open generator of dexterous-hand grasps. ``import lgrasp as lg`` loads nothing heavy."""

import sys
from typing import TYPE_CHECKING

from lgrasp.face import Face

if TYPE_CHECKING:
    from lgrasp.api import (
        Grasps,
        Hand,
        Object,
        generate,
        hands,
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
    from lgrasp.dataset.exports import export_shards, read_grasps
    from lgrasp.dataset.merge import merge_shards
    from lgrasp.dataset.reader import ShardReader, pose_matrix, read_shard
    from lgrasp.dataset.torch_dataset import GraspDataset
    from lgrasp.dataset.validate import validate_shard
    from lgrasp.dataset.writer import write_shard
    from lgrasp.engine.pipeline import load_pipeline
    from lgrasp.errors import LgraspError
    from lgrasp.grasp.bounds import GraspBounds
    from lgrasp.grasp.records import Shard
    from lgrasp.jobs.learn.job import load_predictor
    from lgrasp.judge.run import judge
    from lgrasp.learn.network import best_answers
    from lgrasp.refine.params import LocalSearch
    from lgrasp.refine.refiner import Refiner
    from lgrasp.scenes.reader import SceneReader, read_scene

__version__ = "0.2.0"
__all__ = [
    "GraspBounds",
    "GraspDataset",
    "Grasps",
    "Hand",
    "LgraspError",
    "LocalSearch",
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

sys.modules[__name__].__class__ = Face

"""Grasp shards: the file format, its writer, readers, validator, merge and torch Dataset."""

from typing import TYPE_CHECKING, Any

from lgrasp.dataset.files import find_shards
from lgrasp.dataset.info import describe
from lgrasp.dataset.merge import merge_shards, write_manifest
from lgrasp.dataset.reader import ShardReader, iter_grasps, read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, SequenceRows, Shard, ShardHeader
from lgrasp.grasp.schema import FORMAT_VERSION

if TYPE_CHECKING:
    from lgrasp.dataset.torch_dataset import GraspDataset

__all__ = [
    "FORMAT_VERSION",
    "GraspDataset",
    "GraspRows",
    "HandRecord",
    "ObjectRecord",
    "SequenceRows",
    "Shard",
    "ShardHeader",
    "ShardReader",
    "describe",
    "find_shards",
    "iter_grasps",
    "merge_shards",
    "pose_matrix",
    "read_shard",
    "validate_shard",
    "write_manifest",
    "write_shard",
]


def __getattr__(name: str) -> Any:
    if name == "GraspDataset":  # imports torch, so only when asked for
        from lgrasp.dataset.torch_dataset import GraspDataset

        return GraspDataset
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

"""Grasp shards: the file format, its writer, readers, validator, merge and torch Dataset."""

from lgrasp.dataset.files import find_shards
from lgrasp.dataset.info import describe
from lgrasp.dataset.merge import merge_shards, write_manifest
from lgrasp.dataset.reader import ShardReader, read_shard
from lgrasp.dataset.validate import validate_shard
from lgrasp.dataset.writer import write_shard
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, SequenceRows, Shard, ShardHeader

__all__ = [
    "GraspRows",
    "HandRecord",
    "ObjectRecord",
    "SequenceRows",
    "Shard",
    "ShardHeader",
    "ShardReader",
    "describe",
    "find_shards",
    "merge_shards",
    "read_shard",
    "validate_shard",
    "write_manifest",
    "write_shard",
]

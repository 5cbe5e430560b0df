"""Grasp shards: the file format, its writer, readers, validator, merge and torch Dataset."""

from lgrasp.dataset.reader import ShardReader, iter_grasps, pose_matrix, read_shard
from lgrasp.dataset.records import GraspRows, HandRecord, ObjectRecord, Shard, ShardHeader
from lgrasp.dataset.writer import write_shard

__all__ = ["GraspRows", "HandRecord", "ObjectRecord", "Shard", "ShardHeader", "ShardReader", "iter_grasps", "pose_matrix", "read_shard", "write_shard"]

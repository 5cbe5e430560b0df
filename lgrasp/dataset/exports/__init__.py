"""Grasps in the formats of other programs: writers and readers."""

from lgrasp.dataset.exports.dexgraspbench import read_dexgraspbench
from lgrasp.dataset.exports.dexgraspnet import read_dexgraspnet
from lgrasp.dataset.exports.formats import FORMATS, Exported, Format, export_shards, read_grasps
from lgrasp.dataset.exports.isaac_grasp import read_isaac_grasp
from lgrasp.dataset.exports.mjcf import read_mjcf
from lgrasp.dataset.exports.reading import GraspSet, ReadObject
from lgrasp.dataset.exports.selection import HOLDS

__all__ = [
    "FORMATS",
    "HOLDS",
    "Exported",
    "Format",
    "GraspSet",
    "ReadObject",
    "export_shards",
    "read_dexgraspbench",
    "read_dexgraspnet",
    "read_grasps",
    "read_isaac_grasp",
    "read_mjcf",
]

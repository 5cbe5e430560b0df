"""Objects: mesh file to surface points, obstacle clusters and signed distance grid."""

from lgrasp.geometry.clusters import CLUSTER_SIZE

from .find import find_object, list_objects
from .load import MESH_SUFFIXES
from .model import ObjectModel, preprocess_object
from .params import ObjectParams

__all__ = [
    "CLUSTER_SIZE",
    "MESH_SUFFIXES",
    "ObjectModel",
    "ObjectParams",
    "find_object",
    "list_objects",
    "preprocess_object",
]

"""Point clouds as the objects of jobs: read with what is said of them, whole, and as shards hold them."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from lgrasp.cloud.model import cloud_object, searched_object
from lgrasp.cloud.read import Cloud, read_cloud
from lgrasp.engine.cache import Cache, content_key
from lgrasp.grasp.records import ObjectRecord
from lgrasp.learn.grasp.file import Networks
from lgrasp.learn.grasp.predictor import CloudCompletion
from lgrasp.object.model import ObjectModel
from lgrasp.object.params import ObjectParams
from lgrasp.scenes.files import scene_cloud

VERSION = 3
"""Raised whenever :func:`whole_object` changes for the same arguments."""


def cloud_to_grasp(
    cache: Cache, path: Path, mask: Path | None, label: int | None, scale: float, viewpoint: Sequence[float] | None
) -> Cloud:
    """The cloud of a file, of which a target is to be grasped; what was repaired is told as warnings.

    Raises:
        CloudError: see :func:`~lgrasp.cloud.read.read_cloud`.
    """
    eye = None if viewpoint is None else list(viewpoint)
    cloud = read_cloud(path, mask, label, scale, eye, scene=False, read_scene=scene_cloud)
    for note in cloud.notes:
        cache.warn(note)
    return cloud


def cloud_record(record: ObjectRecord, cloud: Cloud) -> ObjectRecord:
    """The record of a cloud's model with the target's points as they were given, and their normals."""
    target = cloud.only(cloud.target)
    normals = target.normals / np.linalg.norm(target.normals, axis=1, keepdims=True)
    return replace(record, vertices=target.points, normals=normals)


def cloud_key(cloud: Cloud, name: str, networks: str, params: ObjectParams) -> str:
    """Content key of :func:`whole_object`, of networks by the key of their file."""
    target, described = cloud.only(cloud.target), params.model_dump(mode="json")
    seen = [values.tobytes().hex() for values in (target.points, target.normals)]
    return content_key("cloud", VERSION, seen=seen, name=name, networks=networks, params=described)


def network_key(path: Path) -> str:
    """Content key of a network's file."""
    return content_key("network", 1, content=path.read_bytes().hex())


def whole_object(cloud: Cloud, name: str, networks: Networks, params: ObjectParams, device: str) -> ObjectModel:
    """The target of a cloud with the sides that nobody saw, as pipelines search it.

    Args:
        networks: complete it.

    Raises:
        ObjectError: see :func:`~lgrasp.cloud.model.cloud_object`, :func:`~lgrasp.cloud.model.searched_object`.
    """
    target = cloud.only(cloud.target)
    seen = cloud_object(target.points, target.normals, name=name)
    whole = CloudCompletion(networks, seen.contact_points, seen.contact_normals, device).completed(seen)
    return searched_object(whole, params)

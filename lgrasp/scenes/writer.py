"""Writes one whole scene, or nothing."""

import json
import os
from typing import Any

import h5py
import numpy as np

from lgrasp.dataset.files import new_shard_file
from lgrasp.dataset.structure import schema_problems
from lgrasp.dataset.writer import create_array, finish, write_hand, write_object
from lgrasp.errors import ShardError
from lgrasp.scenes.checks import scene_problems
from lgrasp.scenes.records import SceneRecord
from lgrasp.scenes.schema import ATTRIBUTES, DATASETS, FORMAT, FORMAT_VERSION


def write_scene(path: str | os.PathLike[str], scene: SceneRecord) -> None:
    """Write a scene; the file appears under ``path`` only when it is whole and on the disk.

    Raises:
        ShardError: the scene violates the format; nothing is written.
        OutputError: the folder cannot be written or is full; no file is left behind.
    """
    problems = scene_problems(scene)
    if problems:
        raise ShardError(f"cannot write {path}: {problems[0]}")
    with new_shard_file(path) as file:
        file.attrs.update(
            format=FORMAT,
            format_version=FORMAT_VERSION,
            lgrasp_version=scene.lgrasp_version,
            created=scene.created,
            seed=np.int64(scene.seed),
            scene_index=np.int64(scene.index),
            config=json.dumps(dict(scene.config), sort_keys=True),
            hand=scene.hand.name,
            hand_sha256=scene.hand.sha256,
        )
        write_hand(file.create_group("hand"), scene.hand)
        for record in scene.objects:
            write_object(file.create_group(f"objects/{record.id}"), record)
        for name in ("scene", "views", "cloud", "grasps"):
            _write_group(file.create_group(name), scene if name == "scene" else getattr(scene, name))
        file["scene"].attrs["table"] = float(scene.table)
        camera = scene.views.intrinsics
        file["views"].attrs.update(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
        file["grasps"].attrs["tolerance"] = float(scene.grasps.tolerance)
        file.create_group("statistics").attrs.update(dict(scene.statistics))
        finish(file)
        problems = schema_problems(file, DATASETS, ATTRIBUTES)
        if problems:
            raise ShardError(f"cannot write {path}: {problems[0]}")


def _write_group(group: h5py.Group, record: Any) -> None:
    """Write the arrays of a record that the format names in this group."""
    for spec in DATASETS:
        where, _, name = spec.path.partition("/")
        if where == group.name[1:]:
            create_array(group, name, np.asarray(getattr(record, name)).astype(spec.numpy))

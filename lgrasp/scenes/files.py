"""Files of scenes: read whole or by parts, checked, written whole or not at all."""

import json
import os
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from lgrasp.dataset.files import check_heaps
from lgrasp.dataset.reader import FileReader, reading
from lgrasp.dataset.structure import expand, schema_problems, whole_problems
from lgrasp.dataset.validate import file_problems
from lgrasp.dataset.writer import create_array, finish, new_shard_file, write_models
from lgrasp.errors import ShardError
from lgrasp.grasp.schema import DatasetSpec
from lgrasp.picture.camera import Intrinsics
from lgrasp.scenes.records import CloudRecord, SceneGrasps, SceneRecord, ViewsRecord, scene_problems
from lgrasp.scenes.schema import ATTRIBUTES, DATASETS, FORMAT, FORMAT_VERSION


class Layout(NamedTuple):
    """M objects on a table."""

    ids: tuple[str, ...]
    """Each object once, sorted."""
    table: float
    """Side [m]."""
    object_index: np.ndarray
    """Position in ``ids``, shape [M]."""
    object_pose: np.ndarray
    """T_scene_object, x y z [m] qw qx qy qz, shape [M, 7]."""


_GROUPS = ("scene", "views", "cloud", "grasps")


def _members(group: str) -> list[tuple[DatasetSpec, str]]:
    """Datasets of a group, each with its name there."""
    return [(spec, spec.path.partition("/")[2]) for spec in DATASETS if spec.path.startswith(f"{group}/")]


class SceneReader(FileReader):
    """One open scene."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        super().__init__(path, _problems)

    @property
    def config(self) -> dict[str, Any]:
        """Parameters that decided the scene."""
        with reading(self.path):
            return json.loads(self.attributes["config"])

    @property
    def index(self) -> int:
        """Number of the scene in its run."""
        return int(self.attributes["scene_index"])

    def layout(self) -> Layout:
        """The objects on the table, and their poses."""
        with reading(self.path):
            return Layout(tuple(self.object_ids), float(self._file["scene"].attrs["table"]), **self._arrays("scene"))

    def views(self) -> ViewsRecord:
        """Images of the cameras."""
        with reading(self.path):
            attrs, arrays = self._file["views"].attrs, self._arrays("views")
            height, width = arrays["depth"].shape[1:]
            camera = Intrinsics(width, height, *(float(attrs[name]) for name in ("fx", "fy", "cx", "cy")))
            return ViewsRecord(intrinsics=camera, **arrays)

    def cloud(self) -> CloudRecord:
        """The merged cloud."""
        return CloudRecord(**self._arrays("cloud"))

    def grasps(self) -> SceneGrasps:
        """All grasps, those that collide included."""
        with reading(self.path):
            return SceneGrasps(tolerance=float(self._file["grasps"].attrs["tolerance"]), **self._arrays("grasps"))

    def scene(self) -> SceneRecord:
        """Everything."""
        attributes, layout = self.attributes, self.layout()._asdict()
        layout.pop("ids")
        with reading(self.path):
            return SceneRecord(
                seed=int(attributes["seed"]),
                index=self.index,
                hand=self.hand(),
                objects=self.objects(),
                **layout,
                views=self.views(),
                cloud=self.cloud(),
                grasps=self.grasps(),
                config=self.config,
                statistics=self.statistics,
                created=attributes["created"],
                lgrasp_version=attributes["lgrasp_version"],
            )

    def _arrays(self, group: str) -> dict[str, np.ndarray]:
        with reading(self.path):
            return {name: self._file[group][name][()] for _, name in _members(group)}


def read_scene(path: str | os.PathLike[str]) -> SceneRecord:
    """Read a whole scene.

    Raises:
        ShardError: the file is damaged, foreign or of another format version.
    """
    check_heaps(path)
    with SceneReader(path) as reader:
        return reader.scene()


def check_scene(path: str | os.PathLike[str]) -> list[str]:
    """All problems of a scene, one line each; an empty list means that it conforms. Every byte is read."""
    return file_problems(path, _problems, lambda path: scene_problems(read_scene(path)))


def _problems(file: h5py.File) -> tuple[dict[str, Any], list[str]]:
    """The members of a file, and why it is no whole scene of a version that this package reads, one line each."""
    return whole_problems(file, "scene", FORMAT, FORMAT_VERSION, _structure_problems)


def _structure_problems(nodes: dict[str, Any]) -> list[str]:
    if not expand(nodes, "objects/*"):
        return ["objects: no object"]
    missing = [f"{name}: missing group" for name in ("hand", *_GROUPS) if name not in nodes]
    return missing or schema_problems(nodes, DATASETS, ATTRIBUTES)


def scene_cloud(path: Path) -> dict[str, np.ndarray]:
    """The merged cloud of a scene: points (n, 3) [m], normals (n, 3) and labels (n,).

    Raises:
        ShardError: see :class:`SceneReader`.
    """
    with SceneReader(path) as reader:
        cloud = reader.cloud()
    return {"points": cloud.points.astype(np.float64), "normals": cloud.normals, "labels": cloud.labels}


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
        write_models(file, scene.hand, scene.objects)
        for name in _GROUPS:
            group, record = file.create_group(name), scene if name == "scene" else getattr(scene, name)
            for spec, member in _members(name):
                create_array(group, member, getattr(record, member), spec.numpy)
        file["scene"].attrs["table"] = float(scene.table)
        camera = scene.views.intrinsics
        file["views"].attrs.update(fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy)
        file["grasps"].attrs["tolerance"] = float(scene.grasps.tolerance)
        file.create_group("statistics").attrs.update(dict(scene.statistics))
        problems = schema_problems(finish(file), DATASETS, ATTRIBUTES)
        if problems:
            raise ShardError(f"cannot write {path}: {problems[0]}")

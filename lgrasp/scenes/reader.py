"""Reads scenes: whole, or the parts that are asked for."""

import json
import os
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np

from lgrasp.dataset import HandRecord, ObjectRecord
from lgrasp.dataset.heap import check_heaps
from lgrasp.dataset.reader import open_hdf5, read_hand, read_object, reading
from lgrasp.dataset.structure import schema_problems, text_sha256
from lgrasp.errors import ShardError
from lgrasp.scenes.camera import Intrinsics
from lgrasp.scenes.checks import scene_problems
from lgrasp.scenes.records import CloudRecord, SceneGrasps, SceneRecord, ViewsRecord
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


class SceneReader:
    """One open scene; a context manager. Opening reads no array.

    Raises:
        ShardError: On opening, the file is truncated, foreign, of another format version or not of the format's
            structure; on reading, a checksum does not match.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = Path(path)
        self._file = open_hdf5(self.path)
        try:
            with reading(self.path):
                problem = next(iter(_structure_problems(self._file)), None)
            if problem:
                raise ShardError(f"{self.path}: {problem}")
        except BaseException:
            self.close()
            raise

    def __enter__(self) -> "SceneReader":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the file; closing twice is harmless."""
        self._file.close()

    @cached_property
    def attributes(self) -> dict[str, Any]:
        """The root attributes as stored (``config`` is JSON text)."""
        with reading(self.path):
            return dict(self._file.attrs)

    @property
    def config(self) -> dict[str, Any]:
        """Parameters that decided the scene."""
        with reading(self.path):
            return json.loads(self.attributes["config"])

    @property
    def statistics(self) -> dict[str, int | float | str]:
        """Counts and seconds."""
        with reading(self.path):
            attrs = self._file["statistics"].attrs
            return {k: v.item() if isinstance(v, np.generic) else v for k, v in sorted(attrs.items())}

    def hand(self) -> HandRecord:
        """The hand, with its mesh files."""
        with reading(self.path):
            return read_hand(self._file)

    def objects(self) -> tuple[ObjectRecord, ...]:
        """The objects on the table, each once, sorted by id."""
        with reading(self.path):
            return tuple(read_object(self._file, i) for i in sorted(self._file["objects"]))

    def layout(self) -> Layout:
        """The objects on the table, and their poses."""
        with reading(self.path):
            table = float(self._file["scene"].attrs["table"])
            return Layout(tuple(sorted(self._file["objects"])), table=table, **self._arrays("scene"))

    def views(self) -> ViewsRecord:
        """Images of the cameras."""
        with reading(self.path):
            attrs, arrays = self._file["views"].attrs, self._arrays("views")
            height, width = arrays["depth"].shape[1:]
            camera = Intrinsics(width, height, *(float(attrs[name]) for name in ("fx", "fy", "cx", "cy")))
            return ViewsRecord(intrinsics=camera, **arrays)

    def cloud(self) -> CloudRecord:
        """The merged cloud."""
        with reading(self.path):
            return CloudRecord(**self._arrays("cloud"))

    def grasps(self) -> SceneGrasps:
        """All grasps, those that collide included."""
        with reading(self.path):
            return SceneGrasps(tolerance=float(self._file["grasps"].attrs["tolerance"]), **self._arrays("grasps"))

    def scene(self) -> SceneRecord:
        """Everything."""
        layout = self.layout()
        with reading(self.path):
            return SceneRecord(
                seed=int(self.attributes["seed"]),
                index=int(self.attributes["scene_index"]),
                hand=self.hand(),
                objects=self.objects(),
                table=layout.table,
                object_index=layout.object_index,
                object_pose=layout.object_pose,
                views=self.views(),
                cloud=self.cloud(),
                grasps=self.grasps(),
                config=self.config,
                statistics=self.statistics,
                created=self.attributes["created"],
                lgrasp_version=self.attributes["lgrasp_version"],
            )

    def _arrays(self, group: str) -> dict[str, np.ndarray]:
        names = [spec.path.partition("/")[2] for spec in DATASETS if spec.path.startswith(f"{group}/")]
        return {name: self._file[group][name][()] for name in names}


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
    try:
        check_heaps(path)
        with open_hdf5(path) as file, reading(path):
            problems = _structure_problems(file)
            if not problems and file.attrs["text_sha256"] != text_sha256(file):
                problems = ["/: attributes or texts were changed after writing (text_sha256 differs)"]
        return problems or scene_problems(read_scene(path))
    except ShardError as error:
        return [str(error).removeprefix(f"{path}: ")]


def _structure_problems(file: h5py.File) -> list[str]:
    """Why a file is no whole scene of a version that this package reads, one line each."""
    if file.attrs.get("format") != FORMAT:
        return [f"not a scene (attribute format is {file.attrs.get('format')!r}, expected {FORMAT!r})"]
    version = str(file.attrs.get("format_version"))
    if version.partition(".")[0] != FORMAT_VERSION.partition(".")[0]:
        return [f"format_version is {version!r}, this lgrasp reads 1.x; use a newer lgrasp"]
    if not np.array_equal(file.attrs.get("complete"), 1):
        return [f"incomplete (attribute complete is {file.attrs.get('complete')!r}, expected 1)"]
    if not isinstance(file.get("objects"), h5py.Group) or not len(file["objects"]):
        return ["objects: no object"]
    missing = [f"{name}: missing group" for name in ("hand", "scene", "views", "cloud", "grasps") if name not in file]
    return missing or schema_problems(file, DATASETS, ATTRIBUTES)


def scene_cloud(path: Path) -> dict[str, np.ndarray]:
    """The merged cloud of a scene: points (n, 3) [m], normals (n, 3) and labels (n,).

    Raises:
        ShardError: see :class:`SceneReader`.
    """
    with SceneReader(path) as reader:
        cloud = reader.cloud()
    return {"points": cloud.points.astype(np.float64), "normals": cloud.normals, "labels": cloud.labels}

"""The parts of an export other than its grasps: the hand, the meshes, a README, and an index that is written last."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from trimesh import Trimesh
from trimesh.exchange.obj import export_obj

import lgrasp
from lgrasp.dataset.exports.files import write_file
from lgrasp.dataset.exports.grasp_set import ReadObject
from lgrasp.dataset.exports.hand import HandFrames, hand_files
from lgrasp.dataset.exports.selection import ExportObject, Selection
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import inverse

HAND, OBJECTS, GRASPS = "hand", "objects", "grasps"
"""Folders of an export."""
_INDEX = "export.json"
_FORMAT = "lgrasp-export"


def write_assets(out: Path, selection: Selection) -> None:
    """Write the hand (URDF and meshes) and the meshes of the objects, in metres, as OBJ.

    Raises:
        ShardError: A shard lacks a mesh of its hand.
        OutputError: The folder cannot be written.
    """
    files = hand_files(selection.hand, selection.shards[0])
    for name, data in files.items():
        write_file(out / HAND / name, data)
    for item in selection.objects:
        write_file(out / OBJECTS / f"{item.code}.obj", object_text(item))


def object_text(item: ExportObject) -> str:
    """The mesh of an object as OBJ, in metres.

    Raises:
        ShardError: The shard is damaged.
    """
    record = item.mesh()
    mesh = Trimesh(record.vertices, record.faces, process=False)
    header = f"{record.name}, metres, as grasped"
    return export_obj(mesh, include_normals=False, include_texture=False, header=header, digits=9)


def write_index(
    out: Path, selection: Selection, frames: HandFrames, layout: str, conditions: Sequence[str], run_key: str = ""
) -> None:
    """Write ``export.json``; an export without it is not whole.

    Raises:
        OutputError: The folder cannot be written.
    """
    document = {
        "format": _FORMAT,
        "format_version": "1.0",
        "layout": layout,
        "lgrasp_version": lgrasp.__version__,
        "rows": selection.rows,
        "shards": [path.name for path in selection.shards],
        "where": list(conditions),
        "run_key": run_key,
        "hand": {
            "name": selection.hand.name,
            "sha256": selection.hand.sha256,
            "urdf": f"{HAND}/hand.urdf",
            "root_link": frames.root,
            "base_link": frames.base,
            "joint_names": list(frames.joint_names),
            "mimic": {
                name: {"joint": source, "multiplier": multiplier, "offset": offset}
                for name, (source, multiplier, offset) in frames.mimics.items()
            },
        },
        "objects": {
            item.code: {
                "mesh": f"{OBJECTS}/{item.code}.obj",
                "name": item.record.name,
                "source_scale": item.record.scale,
                "source_sha256": item.record.sha256,
                "rows": count,
            }
            for item, count in zip(selection.objects, selection.counts, strict=True)
        },
    }
    write_file(out / _INDEX, json.dumps(document, indent=2) + "\n")


@dataclass(frozen=True)
class ExportFolder:
    """A folder to read grasps from: an export of lgrasp, or one that another program wrote, which tells less."""

    path: Path
    files: tuple[Path, ...]
    """Files of grasps, sorted."""
    joint_names: tuple[str, ...] | None
    """Joints in the order of q, where the folder says so."""
    frames: HandFrames | None
    meshes: Mapping[str, Path]
    """Mesh of each object by its code."""

    def object(self, code: str, scale: float) -> ReadObject:
        """The object of a code."""
        return ReadObject(code, scale, self.meshes.get(code))

    def object_pose(self, pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Objects in the hand's base frame, for root links in the objects' frames; both [n, 7]; q is [n, K]."""
        return inverse(pose) if self.frames is None else self.frames.object_in_base(pose, q)


def open_folder(path: Path, suffix: str, layout: str) -> ExportFolder:
    """Find the files of grasps in an export, in any other folder, or take a single file.

    Raises:
        ShardError: No such folder, no file with the suffix, an export of another format, or one that is not whole.
    """
    if path.is_file():
        return ExportFolder(path, (path,), None, None, {})
    if not path.is_dir():
        raise ShardError(f"{path}: no such file or folder")
    index = path / _INDEX
    if not index.exists() and (path / HAND / "hand.urdf").exists():
        raise ShardError(f"{path}: the export is incomplete, it has no {_INDEX}; export again")
    files = tuple(sorted((path / GRASPS if index.exists() else path).rglob(f"*{suffix}")))
    if not files:
        raise ShardError(f"{path}: no {suffix} file in it")
    if not index.exists():
        return ExportFolder(path, files, None, None, {})
    try:
        document = json.loads(index.read_bytes())
        _require(document, layout)
        hand = document["hand"]
        urdf = (path / HAND / "hand.urdf").read_text(encoding="utf-8")
        names = tuple(map(str, hand["joint_names"]))
        frames = HandFrames(urdf, hand["base_link"], names, path / HAND / "hand.urdf")
        meshes = {code: path / OBJECTS / f"{code}.obj" for code in document["objects"]}
    except OSError as error:
        raise ShardError(f"{error.filename}: {error.strerror or error}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise ShardError(f"{index}: not an index of an export: {error}") from error
    return ExportFolder(path, files, names, frames, meshes)


def _require(document: Any, layout: str) -> None:
    found = {"format": document["format"], "layout": document["layout"]}
    wanted = {"format": _FORMAT, "layout": layout}
    for key, value in wanted.items():
        if found[key] != value:
            raise ValueError(f"{key} is {found[key]!r}, expected {value!r}")

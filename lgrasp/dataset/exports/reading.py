"""What the readers of exports share: the folder, and rows in the shape of a shard's, with names."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lgrasp.dataset.exports.folder import GRASPS, HAND, INDEX, INDEX_FORMAT, OBJECTS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import canonical, inverse
from lgrasp.grasp.records import GraspRows


class ReadObject(NamedTuple):
    """An object that grasps of another format name."""

    code: str
    scale: float
    """Factor from the mesh to metres as grasped."""
    mesh: Path | None
    """Its mesh file, where one is known."""


class GraspSet(NamedTuple):
    """Grasps read from another format."""

    joint_names: tuple[str, ...]
    """Joints in the order of q, length K."""
    objects: tuple[ReadObject, ...]
    """What ``object_index`` counts in."""
    grasps: GraspRows
    """Rows without contacts (C = 0) and without metrics; ``candidate`` counts them. Poses of objects are in the base
    link's frame where the folder names one (an export of lgrasp), else in the frame that the format gives poses of."""


def make_set(
    joint_names: Sequence[str],
    objects: Sequence[ReadObject],
    q: np.ndarray,
    object_pose: np.ndarray,
    object_index: np.ndarray,
) -> GraspSet:
    """Rows in the dtypes of a shard.

    Args:
        joint_names: Length K.
        objects: What ``object_index`` counts in.
        q: Joints [rad or m] at the grasp, before closing, and as targets that press, shape [n, 3, K].
        object_pose: In the hand's frame, x y z [m] qw qx qy qz, shape [n, O, 7]; NaN where absent.
        object_index: Shape [n, O]; -1 where absent.
    """
    n, width = object_index.shape
    pose = np.concatenate([object_pose[..., :3], canonical(object_pose[..., 3:])], -1).astype(np.float32)
    nothing = np.zeros((n, width, 0, 3), np.float32)
    rows = GraspRows(
        q=q[:, 0].astype(np.float32),
        q_pregrasp=q[:, 1].astype(np.float32),
        q_squeeze=q[:, 2].astype(np.float32),
        object_pose=pose,
        object_index=object_index.astype(np.int32),
        contact_points=nothing,
        contact_normals=nothing,
        contact_links=np.zeros((n, width, 0), np.int16),
        contact_forces=nothing,
        candidate=np.arange(n, dtype=np.uint64),
    )
    return GraspSet(tuple(joint_names), tuple(objects), rows)


def order_of(names: Sequence[str], wanted: Sequence[str], where: object) -> list[int]:
    """Place in ``names`` of each wanted joint.

    Raises:
        ShardError: The two do not name the same joints.
    """
    if sorted(names) != sorted(wanted):
        lacking = sorted(set(wanted) - set(names))
        other = f"lacks joint {lacking[0]!r}" if lacking else f"has joint {sorted(set(names) - set(wanted))[0]!r}"
        raise ShardError(f"{where}: {other}; expected {', '.join(wanted)}")
    return [list(names).index(name) for name in wanted]


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

    def place(self, objects: list[ReadObject], code: str, scale: float) -> int:
        """Place of an object in a list, which it is added to if it is not there."""
        known = ReadObject(code, scale, self.meshes.get(code))
        if known not in objects:
            objects.append(known)
        return objects.index(known)

    def rows(
        self, names: Sequence[str], objects: Sequence[ReadObject], q: np.ndarray, pose: np.ndarray, index: Sequence[int]
    ) -> GraspSet:
        """Rows of single objects: ``q`` [n, 3, K] as of :func:`make_set`, root links in the objects' frames [n, 7].

        Raises:
            ShardError: The folder has other joints.
        """
        order = order_of(names, self.joint_names or names, self.path)
        in_hand = self.object_pose(pose, q[:, 0][:, order])
        return make_set(names, objects, q, in_hand[:, None], np.array(index, int).reshape(-1, 1))

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
    index = path / INDEX
    if not index.exists() and (path / HAND / "hand.urdf").exists():
        raise ShardError(f"{path}: the export is incomplete, it has no {INDEX}; export again")
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
    for key, value in (("format", INDEX_FORMAT), ("layout", layout)):
        if document[key] != value:
            raise ValueError(f"{key} is {document[key]!r}, expected {value!r}")

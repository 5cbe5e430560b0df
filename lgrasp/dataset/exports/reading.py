"""What the readers of exports share: the folder, and rows in the shape of a shard's, with names."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from lgrasp.dataset.exports.folder import GRASPS, HAND, INDEX, INDEX_FORMAT, OBJECTS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.files import parsing
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import canonical, inverse
from lgrasp.grasp.records import GraspRows
from lgrasp.grasp.schema import POSTURES
from lgrasp.object.find import mesh_files
from lgrasp.paths import is_litter


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


WRONG = (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError)
"""What is raised where a file holds something else than a format has there."""


def numbers(values: Any, what: str, *shape: int) -> np.ndarray:
    """Finite numbers as float64 in some shape, none: one number; -1: of any length.

    Raises:
        ValueError: They are none, or too many or too few.
    """
    try:
        found = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{what} holds no numbers: {error}") from None
    if not np.isfinite(found).all():
        raise ValueError(f"{what} is not finite")
    try:
        return found.reshape(shape)
    except ValueError:
        expected = " x ".join(str(size) if size >= 0 else "n" for size in shape) or "1"
        raise ValueError(f"{what} has {found.size} numbers, expected {expected}") from None


def order_of(names: Sequence[str], wanted: Sequence[str], where: object) -> list[int]:
    """Place in ``names`` of each wanted joint.

    Raises:
        ShardError: The two do not name the same joints, or one of them twice.
    """
    for given in (names, wanted):
        if len(set(given)) < len(given):
            twice = next(name for name in given if list(given).count(name) > 1)
            raise ShardError(f"{where}: joint {twice!r} is named twice, expected once")
    if sorted(names) != sorted(wanted):
        lacking = sorted(set(wanted) - set(names))
        other = f"lacks joint {lacking[0]!r}" if lacking else f"has joint {sorted(set(names) - set(wanted))[0]!r}"
        raise ShardError(f"{where}: {other}; expected {', '.join(wanted)}")
    return [list(names).index(name) for name in wanted]


@dataclass
class ExportFolder:
    """A folder that grasps are read from: an export of lgrasp, or one that another program wrote, which tells less."""

    path: Path
    files: tuple[Path, ...]
    """Files of grasps, sorted."""
    wanted: tuple[str, ...]
    """Order of q; those of the first grasp where nobody says."""
    joint_names: tuple[str, ...] | None = None
    """Joints in the order of q, where the folder says so."""
    frames: HandFrames | None = None
    meshes: Mapping[str, Path] = field(default_factory=dict)
    """Mesh of each object by its code."""
    objects: list[ReadObject] = field(default_factory=list)
    """Those that grasps named so far."""
    _added: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = field(default_factory=list)  # q, pose and object's place

    def order(self, where: object, names: Iterable[Any]) -> list[int]:
        """As :func:`order_of` the joints that are wanted."""
        listed = tuple(map(str, names))
        self.wanted = self.wanted or listed
        return order_of(listed, self.wanted, where)

    def add(self, where: object, names: Iterable[Any], q: Any, pose: Any, code: str, scale: Any = 1.0) -> None:
        """Take up n grasps of one object.

        Args:
            names: Joints in the order of ``q``.
            q: Joints [rad or m] at the grasp, before closing, and as targets that press, n x 3 x K numbers.
            pose: Root link (or base link, see :meth:`grasps`) in the object's frame, x y z [m] qw qx qy qz, n x 7.
            scale: Factor from its mesh to metres as grasped.

        Raises:
            ShardError: The joints are others than those wanted.
            ValueError: Not so many finite numbers, or a quaternion of length 0.
        """
        order = self.order(where, names)
        q = numbers(q, "joints", -1, 3, len(order))[..., order]
        pose, scale = numbers(pose, "pose", len(q), 7), float(numbers(scale, "scale"))
        if not pose[:, 3:].any(axis=1).all():
            raise ValueError("a quaternion is 0 0 0 0; one of unit length is accepted")
        self._added.append((q, pose, np.full((len(q), 1), self.place(code, scale))))

    def place(self, code: str, scale: float = 1.0) -> int:
        """Place of an object in ``objects``, which it is added to if it is not there."""
        known = ReadObject(code, scale, self.meshes.get(code))
        if known not in self.objects:
            self.objects.append(known)
        return self.objects.index(known)

    def object_pose(self, pose: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Objects in the hand's base frame, for root links in the objects' frames; both [n, 7]; q is [n, K]."""
        return inverse(pose) if self.frames is None else self.frames.object_in_base(pose, q)

    def grasps(self, *, of_base: bool = False) -> GraspSet:
        """What was added; its poses are those of the hand's base link, or of its root link.

        Raises:
            ShardError: The folder has other joints.
        """
        nothing = np.zeros((0, 3, len(self.wanted))), np.zeros((0, 7)), np.zeros((0, 1), int)
        q, pose, index = map(np.concatenate, zip(nothing, *self._added, strict=True))
        order = order_of(self.wanted, self.joint_names or self.wanted, self.path)
        object_pose = inverse(pose) if of_base else self.object_pose(pose, q[:, 0][:, order])
        return self.rows(q, object_pose[:, None], index)

    def rows(self, q: np.ndarray, object_pose: np.ndarray, object_index: np.ndarray) -> GraspSet:
        """Rows in the dtypes of a shard.

        Args:
            q: Joints [rad or m] at the grasp, before closing, and as targets that press, shape [n, 3, K].
            object_pose: In the hand's frame, x y z [m] qw qx qy qz, shape [n, O, 7]; NaN where absent.
            object_index: Shape [n, O]; -1 where absent.
        """
        n, width = object_index.shape
        pose = np.concatenate([object_pose[..., :3], canonical(object_pose[..., 3:])], -1)
        nothing = np.zeros((n, width, 0, 3), np.float32)
        grasps = GraspRows(
            **dict(zip(POSTURES, np.moveaxis(q, 1, 0).astype(np.float32), strict=True)),
            object_pose=pose.astype(np.float32),
            object_index=object_index.astype(np.int32),
            contact_points=nothing,
            contact_normals=nothing,
            contact_links=np.zeros((n, width, 0), np.int16),
            contact_forces=nothing,
            candidate=np.arange(n, dtype=np.uint64),
        )
        return GraspSet(self.wanted, tuple(self.objects), grasps)


def objects_beside(path: Path) -> Path:
    """Where the meshes of objects are that grasps in a folder or file name: ``objects`` there, or beside the nearest
    ``grasps`` that it is in."""
    folder = path if path.is_dir() else path.parent
    if folder.name != GRASPS and (folder / OBJECTS).is_dir():
        return folder / OBJECTS
    above = folder.absolute()
    return next((at.parent for at in (above, *above.parents) if at.name == GRASPS), folder) / OBJECTS


def open_folder(path: Path | str, suffix: str, layout: str, wanted: Sequence[str] | None) -> ExportFolder:
    """Find the files of grasps in an export, in any other folder, or take a single file.

    Raises:
        ShardError: No such folder, no file with the suffix, an export of another format, or one that is not whole.
    """
    path, order = Path(path), tuple(wanted or ())
    beside = mesh_files(objects_beside(path))
    if path.is_file():
        return ExportFolder(path, (path,), order, meshes=beside)
    if not path.is_dir():
        raise ShardError(f"{path}: no such file or folder")
    index, urdf = path / INDEX, path / HAND / "hand.urdf"
    if not index.exists() and urdf.exists():
        raise ShardError(f"{path}: the export is incomplete, it has no {INDEX}; export again")
    inside = (path / GRASPS if index.exists() else path).rglob(f"*{suffix}")
    files = tuple(sorted(file for file in inside if not is_litter(file.name)))
    if not files:
        raise ShardError(f"{path}: no {suffix} file in it")
    if not index.exists():
        return ExportFolder(path, files, order, meshes=beside)
    with parsing(index, "an index of an export", (ValueError, KeyError, TypeError)):
        document = json.loads(index.read_bytes())
        for key, value in (("format", INDEX_FORMAT), ("layout", layout)):
            if document[key] != value:
                raise ValueError(f"{key} is {document[key]!r}, expected {value!r}")
        hand = document["hand"]
        names = tuple(map(str, hand["joint_names"]))
        frames = HandFrames(urdf.read_text(encoding="utf-8"), hand["base_link"], names, urdf)
        meshes = {code: path / OBJECTS / f"{code}.obj" for code in document["objects"]}
    return ExportFolder(path, files, order or names, names, frames, meshes)

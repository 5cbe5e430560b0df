"""DexGraspBench, the layout of BODex: one .npy file per grasp, a dictionary of poses and joint vectors."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.exports.folder import GRASPS, OBJECTS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.npy import load_objects, save_object
from lgrasp.dataset.exports.reading import GraspSet, open_folder
from lgrasp.dataset.exports.selection import Selection
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import compose, inverse

_POSTURES = ("grasp_qpos", "pregrasp_qpos", "squeeze_qpos")

DEXGRASPBENCH_NOTES = """\
grasps/CODE/NUMBER.npy    DexGraspBench (BODex) layout: np.load(FILE, allow_pickle=True).item() is a dictionary.

  obj_path         mesh of the object, relative to this folder
  obj_scale        1.0: the mesh is in metres as grasped
  obj_pose         x y z [m] qw qx qy qz of the object in the world: the origin, not turned
  pregrasp_qpos    x y z [m] qw qx qy qz of link {root} in the world, then the joints in the order of joint_names
  grasp_qpos       the same at the grasp
  squeeze_qpos     the same with joint targets that press on the object
  joint_names      order of the joints, an addition of lgrasp
{table}
{root} is the root link of hand/hand.urdf. A model of the hand that is turned or shifted against this URDF (as some
MJCF files are) needs that turn applied to the first seven numbers.
"""


def write_dexgraspbench(selection: Selection, frames: HandFrames, out: Path, advance: Callable[[int], None]) -> None:
    """Write ``grasps/CODE/NUMBER.npy`` for every row, numbered over the whole export."""
    for batch in selection.batches():
        pose = frames.root_in_object(batch.object_pose[:, 0], batch.q)  # (n, 7)
        postures = [np.concatenate([pose, q], -1) for q in batch.postures]
        tables = batch.tables()
        for row, number in enumerate(batch.number):
            code = selection.objects[batch.object_index[row, 0]].code
            entry = {
                "obj_path": f"{OBJECTS}/{code}.obj",
                "obj_scale": 1.0,
                "obj_pose": np.array([0, 0, 0, 1.0, 0, 0, 0]),
                **{name: values[row] for name, values in zip(_POSTURES, postures, strict=True)},
                "joint_names": list(frames.joint_names),
                **{name: np.array(values) for name, values in tables[row].items()},
            }
            save_object(out / GRASPS / code / f"{number:08d}.npy", entry)
            advance(1)


def read_dexgraspbench(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export, a folder of .npy files of one grasp each, or one such file, by whichever program it was written.

    The hand's pose is that of ``grasp_qpos``; a hand that moves between the postures is not represented. Files without
    ``joint_names`` are taken to be in the order wanted. Arguments and errors as of
    :func:`~lgrasp.dataset.exports.formats.read_grasps`.
    """
    folder = open_folder(path, ".npy", "dexgraspbench", joint_names)
    index, root, q, world = [], [], [], []
    for file in folder.files:
        entry = next(iter(load_objects(file)), None)
        if not isinstance(entry, dict):
            raise ShardError(f"{file}: no dictionary of one grasp")
        listed = tuple(map(str, entry.get("joint_names", folder.joint_names or folder.wanted)))
        if not listed and not folder.wanted:
            raise ShardError(f"{file}: does not name its joints; give joint_names")
        order = folder.order(listed, file)
        postures = [_numbers(entry, posture, 7 + len(order), file) for posture in _POSTURES]
        root.append(postures[0][:7])
        q.append([values[7:][order] for values in postures])
        world.append(_numbers(entry, "obj_pose", 7, file))
        if not (world[-1][3:].any() and root[-1][3:].any()):
            raise ShardError(f"{file}: a quaternion is 0 0 0 0; one of unit length is accepted")
        scale, mesh = float(_numbers(entry, "obj_scale", 1, file)[0]), entry.get("obj_path")
        if not isinstance(mesh, str):
            raise ShardError(f"{file}: obj_path is {mesh!r}, expected the path of a mesh")
        index.append(folder.place(Path(mesh).stem, scale))
    return folder.single(np.array(q), compose(inverse(np.array(world)), np.array(root)), index)


def _numbers(entry: dict[str, Any], key: str, count: int, file: Path) -> np.ndarray:
    try:
        values = np.asarray(entry[key], np.float64).reshape(-1)
    except KeyError:
        raise ShardError(f"{file}: has no {key!r}") from None
    except (TypeError, ValueError) as error:
        raise ShardError(f"{file}: {key} holds no numbers: {error}") from None
    if len(values) != count or not np.isfinite(values).all():
        raise ShardError(f"{file}: {key} has {len(values)} numbers, expected {count}, all finite")
    return values

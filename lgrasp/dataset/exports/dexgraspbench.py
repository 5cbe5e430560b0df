"""DexGraspBench, the layout of BODex: one .npy file per grasp, a dictionary of poses and joint vectors."""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from lgrasp.dataset.exports.folder import GRASPS, OBJECTS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.npy import load_objects, save_object
from lgrasp.dataset.exports.reading import WRONG, GraspSet, numbers, open_folder
from lgrasp.dataset.exports.selection import Selection
from lgrasp.dataset.files import parsing
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
    for file in folder.files:
        with parsing(file, "a grasp of DexGraspBench", WRONG):
            entry = load_objects(file)[0]
            names = entry.get("joint_names", folder.joint_names or folder.wanted)
            if not len(names):
                raise ShardError(f"{file}: does not name its joints; give joint_names")
            postures = np.stack([numbers(entry[key], key, 7 + len(names)) for key in _POSTURES])
            world, mesh = numbers(entry["obj_pose"], "obj_pose", 7), entry["obj_path"]
            if not world[3:].any() or not postures[0, 3:7].any():
                raise ValueError("a quaternion is 0 0 0 0; one of unit length is accepted")
            if not isinstance(mesh, str):
                raise ValueError(f"obj_path is {mesh!r}, expected the path of a mesh")
            root = compose(inverse(world), postures[0, :7])
            folder.add(file, names, postures[:, 7:], root, Path(mesh).stem, entry["obj_scale"])
    return folder.grasps()

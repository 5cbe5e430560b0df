"""DexGraspNet: one .npy file per object, a list of dictionaries with the wrist as Euler angles and the joints."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.dataset.exports.folder import GRASPS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.npy import load_objects, save_objects
from lgrasp.dataset.exports.reading import WRONG, GraspSet, numbers, open_folder
from lgrasp.dataset.exports.selection import Batch, Selection
from lgrasp.dataset.files import parsing
from lgrasp.geometry.poses import euler_from_quaternion, quaternion_from_euler

_WRIST = ("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz")
_POSTURES = ("qpos", "qpos_pregrasp", "qpos_squeeze")

DEXGRASPNET_NOTES = """\
grasps/CODE.npy    DexGraspNet layout: np.load(FILE, allow_pickle=True) is an array of dictionaries, one per grasp.

  scale            1.0: objects/CODE.obj is in metres as grasped
  qpos             WRJTx WRJTy WRJTz: position [m] of link {root} in the object's frame;
                   WRJRx WRJRy WRJRz: its rotation [rad], Euler angles about the fixed axes x, y, z in this order
                   (sxyz): R = Rz(WRJRz) Ry(WRJRy) Rx(WRJRx);
                   then one value per joint, by name
  qpos_pregrasp    the same before closing; qpos_squeeze: targets that press. Both are additions of lgrasp.
{table}
The object is at the origin. {root} is the root link of hand/hand.urdf.
"""


def write_dexgraspnet(selection: Selection, frames: HandFrames, out: Path, advance: Callable[[int], None]) -> None:
    """Write ``grasps/CODE.npy`` for every object; memory does not grow with the rows."""
    for place, item in enumerate(selection.objects):
        rows = (entry for batch in selection.batches(place, advance) for entry in _entries(batch, frames))
        save_objects(out / GRASPS / f"{item.code}.npy", selection.counts[place], rows)


def _entries(batch: Batch, frames: HandFrames) -> Iterator[dict[str, Any]]:
    pose = frames.root_in_object(batch.object_pose[:, 0], batch.q)  # (n, 7)
    wrist = np.concatenate([pose[:, :3], euler_from_quaternion(pose[:, 3:])], -1)  # (n, 6)
    names = (*_WRIST, *frames.joint_names)
    postures = zip(*(np.concatenate([wrist, q], -1).tolist() for q in batch.postures), strict=True)
    for values, table in zip(postures, batch.tables(), strict=True):
        qpos = (dict(zip(names, v, strict=True)) for v in values)
        yield {"scale": 1.0} | dict(zip(_POSTURES, qpos, strict=True)) | table


def read_dexgraspnet(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export, a folder of ``CODE.npy``, or one such file, by whichever program it was written.

    What lacks ``qpos_pregrasp`` or ``qpos_squeeze`` gets the joints of the grasp there. Arguments and errors as of
    :func:`~lgrasp.dataset.exports.formats.read_grasps`.
    """
    folder = open_folder(path, ".npy", "dexgraspnet", joint_names)
    for file in folder.files:
        for number, entry in enumerate(load_objects(file)):
            where = f"{file}: entry {number}"
            with parsing(where, "a grasp of DexGraspNet", WRONG):
                names = [name for name in entry["qpos"] if name not in _WRIST]
                folder.order(where, names)
                values = [[entry.get(key, entry["qpos"])[name] for name in (*_WRIST, *names)] for key in _POSTURES]
                table = numbers(values, "qpos", 3, 6 + len(names))
                pose = np.concatenate([table[0, :3], quaternion_from_euler(table[0, 3:6])])
                folder.add(where, names, table[:, 6:], pose, file.stem, entry.get("scale", 1.0))
    return folder.grasps()

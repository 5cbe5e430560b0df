"""GraspGen: one JSON file per object, the gripper's poses in the object's frame and which of them hold."""

import json
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from lgrasp.dataset.exports.folder import CSPACE_POSTURES, GRASPS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.reading import WRONG, GraspSet, numbers, open_folder
from lgrasp.dataset.exports.selection import Batch, Selection
from lgrasp.dataset.files import parsing
from lgrasp.errors import ShardError
from lgrasp.files import new_file
from lgrasp.geometry.poses import pose_from_matrix, pose_matrix

_DECIMALS = 9

GRASPGEN_NOTES = """\
grasps/CODE.json   GraspGen's format of training data: all grasps of one object. It also asks for train.txt and
                   valid.txt, which list meshes, a line CODE.obj each.

  object           file: the mesh, relative to objects/; scale 1.0: it is in metres as grasped
  grasps           lists with an entry for each grasp
    transforms         4 x 4 transforms of link {root} of hand/hand.urdf in the object's frame
    object_in_gripper  true; false where a simulator saw the grasp fail, or the row fails a bound
    joint_names        order of the joints, an addition of lgrasp, as the next three
    cspace_position, pregrasp_cspace_position, squeeze_cspace_position
                       joints at the grasp [rad or m], before closing, and as targets that press
{table}
{root} is the root link of hand/hand.urdf; GraspGen's file of a gripper turns it to z forward, x across the fingers
(transform_offset_from_asset_to_graspgen_convention).
"""


def write_graspgen(selection: Selection, frames: HandFrames, out: Path, advance: Callable[[int], None]) -> None:
    """Write ``grasps/CODE.json`` for every object, list by list; memory does not grow with the rows."""
    lists: dict[str, Callable[[Batch], np.ndarray]] = {
        "transforms": lambda batch: pose_matrix(frames.root_in_object(batch.object_pose[:, 0], batch.q)),
        "object_in_gripper": lambda batch: batch.holds > 0,
        **{name: lambda batch, k=k: batch.postures[k] for k, name in enumerate(CSPACE_POSTURES)},
    }
    if selection.on_table:
        lists |= {name: lambda batch, name=name: batch.table[name] for name in ("table_plane", "table_approach")}
    for place, item in enumerate(selection.objects):
        head = {"object": {"file": f"{item.code}.obj", "scale": 1.0}}
        with new_file(out / GRASPS / f"{item.code}.json") as file:
            names = json.dumps(list(frames.joint_names))
            file.write(f'{json.dumps(head)[:-1]}, "grasps": {{"joint_names": {names}'.encode())
            for name, values in lists.items():
                last = advance if name == [*lists][-1] else None
                file.write(f',\n"{name}": ['.encode())
                for text in _entries(selection.batches(place, last), values):
                    file.write(text.encode())
                file.write(b"]")
            file.write(b"}}\n")


def _entries(batches: Iterator[Batch], values: Callable[[Batch], np.ndarray]) -> Iterator[str]:
    between = ""
    for batch in batches:
        found = values(batch)
        rounded = found if found.dtype == bool else np.round(found, _DECIMALS)
        yield between + json.dumps(rounded.tolist())[1:-1]
        between = ",\n"


def read_graspgen(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export, a folder of JSON files, or one such file. Only those that tell joints are of hands with fingers.

    What lacks a posture gets the joints of the grasp there; which grasps hold is not kept. Arguments and errors as of
    :func:`~lgrasp.dataset.exports.formats.read_grasps`.
    """
    folder = open_folder(path, ".json", "graspgen", joint_names)
    for file in folder.files:
        with parsing(file, "a GraspGen file", WRONG):
            document = json.loads(file.read_bytes())
            mesh, grasps = document["object"], document["grasps"]
            if "joint_names" not in grasps:
                raise ShardError(f"{file}: names no joints (joint_names, cspace_position), which a hand's grasps need")
            T, names = numbers(grasps["transforms"], "transforms", -1, 4, 4), grasps["joint_names"]
            postures = [(key, grasps.get(key, grasps["cspace_position"])) for key in CSPACE_POSTURES]
            q = np.stack([numbers(values, key, len(T), len(names)) for key, values in postures], axis=1)
            folder.add(file, names, q, pose_from_matrix(T), Path(str(mesh["file"])).stem, mesh["scale"])
    return folder.grasps()

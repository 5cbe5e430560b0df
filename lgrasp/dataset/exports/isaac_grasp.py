"""isaac_grasp 1.0: one YAML file per object, the gripper's pose in the object's frame and joints by name."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import yaml

from lgrasp.config import load_yaml
from lgrasp.dataset.exports.folder import CSPACE_POSTURES, GRASPS
from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.dataset.exports.reading import WRONG, GraspSet, open_folder
from lgrasp.dataset.exports.selection import Batch, Selection
from lgrasp.dataset.files import parsing
from lgrasp.files import new_file
from lgrasp.geometry.poses import inverse

ISAAC_GRASP_NOTES = """\
grasps/CODE.yaml   isaac_grasp format, version 1.0: all grasps of one object by name.

  object_frame_link, gripper_frame_link    the object's mesh frame, and link {base} of hand/hand.urdf. NVIDIA's pages
                   call them object_frame and gripper_frame as well; both are given.
  confidence       1.0; 0.0 where a simulator saw the grasp fail, or metric valid is 0
  position         x y z [m] of {base} in the object's frame
  orientation      w and xyz of its quaternion, unit, w >= 0
  cspace_position  joints at the grasp by name [rad or m]
  pregrasp_cspace_position    joints before closing
  squeeze_cspace_position     joint targets that press on the object, an addition of lgrasp
{table}"""


def write_isaac_grasp(selection: Selection, frames: HandFrames, out: Path, advance: Callable[[int], None]) -> None:
    """Write ``grasps/CODE.yaml`` for every object; memory does not grow with the rows."""
    for place, item in enumerate(selection.objects):
        head = {"format": "isaac_grasp", "format_version": 1.0}
        head |= {"object_frame_link": item.code, "gripper_frame_link": frames.base}
        head |= {"object_frame": item.code, "gripper_frame": frames.base}
        with new_file(out / GRASPS / f"{item.code}.yaml") as file:
            file.write(yaml.safe_dump(head, sort_keys=False, allow_unicode=True).encode() + b"grasps:\n")
            for batch in selection.batches(place, advance):
                file.write(_entries(batch, frames).encode())


def _entries(batch: Batch, frames: HandFrames) -> str:
    """Grasps in YAML; numbers have nine decimals, names are quoted as in JSON, which YAML understands."""
    pose = inverse(batch.object_pose[:, 0])  # (n, 7)
    form = ", ".join(f"{json.dumps(name).replace(chr(37), chr(37) * 2)}: %.9f" for name in frames.joint_names)
    lines, tables = [], batch.tables()
    for row, number in enumerate(batch.number):
        x, y, z, w, *v = (f"{value:.9f}" for value in pose[row])
        lines += [
            f"  grasp_{number}:",
            f"    confidence: {batch.holds[row]:.1f}",
            f"    position: [{x}, {y}, {z}]",
            f"    orientation: {{w: {w}, xyz: [{', '.join(v)}]}}",
            *(
                f"    {name}: {{{form % tuple(q[row])}}}"
                for name, q in zip(CSPACE_POSTURES, batch.postures, strict=True)
            ),
            *(f"    {name}: [{', '.join(f'{v:.9f}' for v in values)}]" for name, values in tables[row].items()),
        ]
    return "\n".join(lines) + "\n"


def read_isaac_grasp(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export, a folder of YAML files, or one such file, by whichever program it was written.

    What lacks a posture gets the joints of the grasp there. Names and confidences of grasps are not kept. Arguments
    and errors as of :func:`~lgrasp.dataset.exports.formats.read_grasps`.
    """
    folder = open_folder(path, ".yaml", "isaac-grasp", joint_names)
    for file in folder.files:
        with parsing(file, "an isaac_grasp file", (yaml.YAMLError, *WRONG)):
            document = load_yaml(file.read_bytes())
            version = document["format"], float(document["format_version"])
            if version != ("isaac_grasp", 1.0):
                raise ValueError(f"it is {version[0]} {version[1]}, expected isaac_grasp 1.0")
            grasps = document["grasps"].items()
        for name, entry in grasps:
            with parsing(where := f"{file}: {name}", "a grasp of isaac_grasp 1.0", WRONG):
                turn, joints = entry["orientation"], entry["cspace_position"]
                folder.order(where, joints)
                q = [[entry.get(key, joints)[joint] for joint in joints] for key in CSPACE_POSTURES]
                folder.add(where, joints, q, (*entry["position"], turn["w"], *turn["xyz"]), file.stem)
    return folder.grasps(of_base=True)

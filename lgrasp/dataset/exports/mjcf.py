"""MJCF: one MuJoCo scene per grasp, with keyframes before closing, at the grasp and squeezing."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path

import numpy as np
from lxml import etree

from lgrasp.dataset.exports.files import write_small
from lgrasp.dataset.exports.folder import GRASPS, HAND, OBJECTS, object_text, open_folder
from lgrasp.dataset.exports.hand import HandFrames, hand_files
from lgrasp.dataset.exports.mjcf_scene import Keyframe, Scene
from lgrasp.dataset.exports.plan import Batch, Plan
from lgrasp.dataset.exports.poses import inverse
from lgrasp.dataset.exports.records import GraspSet, ReadObject, make_set, order_of
from lgrasp.errors import ShardError

__all__ = ["MJCF_NOTES", "check_mjcf", "read_mjcf", "write_mjcf"]

_KEYS = ("grasp", "pregrasp", "squeeze")

MJCF_NOTES = """\
grasps/NUMBER.xml  MuJoCo scene of one grasp: mujoco.MjModel.from_xml_path(FILE), then
                   mujoco.mj_resetDataKeyframe(model, data, model.key(NAME).id).

  keyframe grasp     the hand at the grasp, its actuators holding it there
  keyframe pregrasp  the hand before closing
  keyframe squeeze   the hand at the grasp, its actuators pressing on the object
  actuators          one position servo per joint of the list below, named as it is: 5 N m/rad (500 N/m for sliding
                     joints), critically damped. Joints that follow others are tied by equality constraints.
  bodies             the links of hand.urdf under their names; object_PLACE_CODE, free, 0.1 kg

The world's frame is that of link {root}, the root link of hand/hand.urdf, which is fixed. No gravity; friction 0.6.
MuJoCo collides with the convex hull of a mesh: hollows of an object, such as the inside of a mug, are filled, and the
fingers may start inside them. Links whose hulls overlap at the grasp are kept from colliding with each other.
"""


def check_mjcf(plan: Plan, frames: HandFrames) -> None:
    """See that MuJoCo takes the hand and the objects of the first row, before anything is written.

    Raises:
        ConfigError: MuJoCo is not installed.
        ShardError: MuJoCo refuses the hand or a mesh, or a shard is damaged.
    """
    index = next(plan.batches()).object_index[0]
    _scene(plan, frames, tuple(index[index >= 0].tolist()))


def write_mjcf(out: Path, plan: Plan, frames: HandFrames, advance: Callable[[int], None]) -> None:
    """Write ``grasps/NUMBER.xml`` for every row, numbered over the whole export.

    Args:
        out: Folder of the export.
        plan: Rows of one or several objects.
        frames: The plan's hand.
        advance: Called with numbers of rows that are done.

    Raises:
        ShardError: A shard is damaged, or MuJoCo refuses a mesh.
        OutputError: The folder cannot be written.
    """
    scene = lru_cache(maxsize=16)(lambda objects: _scene(plan, frames, objects))
    for batch in plan.batches():
        poses = _in_root(batch, frames)  # (n, O, 7)
        joints = [frames.all_joints(values) for values in (batch.q, batch.q_pregrasp)]
        for row, number in enumerate(batch.number):
            present = batch.object_index[row] >= 0
            objects = tuple(batch.object_index[row, present].tolist())
            at, before = ({name: float(v[row]) for name, v in values.items()} for values in joints)
            keys = [
                Keyframe(_KEYS[0], at, batch.q[row], poses[row, present]),
                Keyframe(_KEYS[1], before, batch.q_pregrasp[row], poses[row, present]),
                Keyframe(_KEYS[2], at, batch.q_squeeze[row], poses[row, present]),
            ]
            write_small(out / GRASPS / f"{number:08d}.xml", scene(objects).text(keys).encode())
            advance(1)


def _scene(plan: Plan, frames: HandFrames, objects: tuple[int, ...]) -> Scene:
    files = {f"{HAND}/{name}": data for name, data in hand_files(plan.hand, plan.shards[0]).items()}
    codes = [plan.objects[i].code for i in objects]
    meshes = [f"{OBJECTS}/{code}.obj" for code in codes]
    files |= {mesh: object_text(plan.objects[i]).encode() for i, mesh in zip(objects, meshes, strict=True)}
    return Scene(files, frames, meshes, codes, "../")


def _in_root(batch: Batch, frames: HandFrames) -> np.ndarray:
    """``T_root_object``, shape [n, O, 7]; NaN where absent."""
    columns = np.moveaxis(batch.object_pose, 1, 0)
    return np.stack([inverse(frames.root_in_object(pose, batch.q)) for pose in columns], axis=1)


def read_mjcf(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export's scenes.

    Args:
        path: Export of lgrasp; scenes by others say too little.
        joint_names: Wanted order of q; by default that of the export.

    Raises:
        ShardError: No whole export, a scene is damaged, or other joints are wanted.
    """
    folder = open_folder(Path(path), ".xml", "mjcf")
    if folder.frames is None or folder.joint_names is None:
        raise ShardError(f"{path}: no export.json in it; only scenes of a whole export can be read")
    names = tuple(joint_names or folder.joint_names)
    wanted = order_of(folder.joint_names, names, path)
    objects: list[ReadObject] = []
    q, poses, index = [], [], []
    for file in folder.files:
        values, seen = _read(file, folder.joint_names)
        known = [folder.object(code, 1.0) for code, _ in seen]
        objects += [item for item in dict.fromkeys(known) if item not in objects]
        q.append(values)
        poses.append([pose for _, pose in seen])
        index.append([objects.index(item) for item in known])
    joints = np.array(q)  # (n, 3, K)
    width = max(map(len, index))
    pose, place = np.full((len(index), width, 7), np.nan), np.full((len(index), width), -1)
    for row, (some, where) in enumerate(zip(poses, index, strict=True)):
        pose[row, : len(some)], place[row, : len(some)] = some, where
    for column in range(width):
        present = place[:, column] >= 0
        pose[present, column] = folder.object_pose(inverse(pose[present, column]), joints[present, 0])
    return make_set(names, objects, joints[:, :, wanted], pose, place)


def _read(file: Path, joint_names: Sequence[str]) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """Joints of grasp, pregrasp and squeeze, shape [3, K]; code and pose in the world of every object."""
    try:
        root = etree.fromstring(file.read_bytes(), etree.XMLParser(resolve_entities=False, no_network=True))
        keys = {key.get("name"): key for key in root.iter("key")}
        at, before = (np.array(keys[name].get("qpos").split(), float) for name in _KEYS[:2])
        targets = np.array(keys[_KEYS[2]].get("ctrl").split(), float)
        drives = [actuator.get("joint") for actuator in root.find("actuator")]
        start, places, objects = 0, {}, []
        for joint in root.find("worldbody").iter("joint", "freejoint"):  # in the order of qpos
            name, free = joint.get("name"), joint.tag == "freejoint" or joint.get("type") == "free"
            if free:
                objects.append((name.split("_", 2)[2], at[start : start + 7]))
            else:
                places[name] = start
            start += 7 if free else 1
        columns = [places[name] for name in joint_names]
        squeeze = targets[[drives.index(name) for name in joint_names]]
        return np.stack([at[columns], before[columns], squeeze]), objects
    except OSError as error:
        raise ShardError(f"{file}: {error.strerror or error}") from error
    except (etree.XMLSyntaxError, AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise ShardError(f"{file}: not a scene of an export: {' '.join(str(error).split())[:200]}") from None

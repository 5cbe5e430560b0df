"""MJCF: one MuJoCo scene per grasp, with keyframes before closing, at the grasp and squeezing."""

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from lxml import etree
from trimesh import Trimesh

from lgrasp.dataset.exports.folder import GRASPS, HAND, OBJECTS, mesh_text, object_text
from lgrasp.dataset.exports.hand import HandFrames, hand_files
from lgrasp.dataset.exports.mjcf_scene import Keyframe, MjcfScene, SceneObject
from lgrasp.dataset.exports.reading import WRONG, GraspSet, open_folder, order_of
from lgrasp.dataset.exports.selection import Selection
from lgrasp.dataset.files import parsing
from lgrasp.errors import ShardError
from lgrasp.files import write_file
from lgrasp.geometry.poses import inverse
from lgrasp.grasp.records import ObjectRecord
from lgrasp.object.mass import mass_properties

Cut = Callable[[ObjectRecord], Sequence[np.ndarray]]
"""Convex pieces of an object, vertices [m] of each, shape [V, 3]."""

_KEYS = ("grasp", "pregrasp", "squeeze")

MJCF_NOTES = """\
grasps/NUMBER.xml  MuJoCo scene of one grasp: mujoco.MjModel.from_xml_path(FILE), then
                   mujoco.mj_resetDataKeyframe(model, data, model.key(NAME).id).

  keyframe grasp     the hand at the grasp, its actuators holding it there
  keyframe pregrasp  the hand before closing
  keyframe squeeze   the hand at the grasp, its actuators pressing on the object
  actuators          one position servo per joint of the list below, named as it is: 5 N m/rad (500 N/m for sliding
                     joints), critically damped. Joints that follow others are tied by equality constraints.
  bodies             the links of hand.urdf under their names; object_PLACE_CODE, free, 0.1 kg. PLACE counts the objects
                     in the hand from 0, in the order in which they were taken; all are where they are at the grasp of
                     the last one, which keyframe pregrasp is before.

The world's frame is that of link {root}, the root link of hand/hand.urdf, which is fixed. No gravity; friction 0.6,
none between links of the hand; all numbers are those of protocol fc of lgrasp simulate.
An object collides with the convex pieces objects/CODE/piece_NN.obj; where there are none, with the hull of its mesh,
which fills its hollows. A mesh of the hand collides with its hull; links whose hulls overlap at the grasp are kept from
colliding with each other.
"""


class MjcfWriter:
    """Writes ``grasps/NUMBER.xml`` for every row, numbered over the whole export.

    Args:
        selection: Rows of one or several objects.
        frames: The selection's hand.
        cut: Convex pieces of an object; without it the hull of its mesh collides.

    Raises:
        PhysicsError: MuJoCo is not installed, or refuses the hand or an object, of the first row at once.
        ShardError: A shard is damaged.
        OutputError: The folder cannot be written.
    """

    def __init__(self, selection: Selection, frames: HandFrames, cut: Cut | None = None) -> None:
        self._selection, self._frames, self._cut = selection, frames, cut
        self._hand = {f"{HAND}/{name}": data for name, data in hand_files(selection.hand, selection.shards[0]).items()}
        self._object = cache(self._make_object)
        self._scene = lru_cache(maxsize=16)(
            lambda objects: MjcfScene(self._hand, frames, [*map(self._object, objects)])
        )
        index = next(selection.batches()).object_index[0]
        self._scene(tuple(index[index >= 0].tolist()))

    def __call__(self, out: Path, advance: Callable[[int], None]) -> None:
        """Write into the folder of an export, calling ``advance`` with numbers of rows that are done."""
        frames = self._frames
        for place in range(len(self._selection.objects)):
            for name, data in self._object(place).pieces.items():
                write_file(out / name, data)
        for batch in self._selection.batches():
            in_root = [inverse(frames.root_in_object(pose, batch.q)) for pose in np.moveaxis(batch.object_pose, 1, 0)]
            poses = np.stack(in_root, axis=1)  # (n, O, 7), NaN where absent
            joints = [frames.all_joints(values) for values in (batch.q, batch.q_pregrasp)]
            for row, number in enumerate(batch.number):
                present = batch.object_index[row] >= 0
                pose, objects = poses[row, present], tuple(batch.object_index[row, present].tolist())
                at, before = ({name: float(v[row]) for name, v in values.items()} for values in joints)
                keys = [
                    Keyframe(name, posture, targets[row], pose)
                    for name, posture, targets in zip(_KEYS, (at, before, at), batch.postures, strict=True)
                ]
                write_file(out / GRASPS / f"{number:08d}.xml", self._scene(objects).text(keys), flush=False)
                advance(1)

    def _make_object(self, place: int) -> SceneObject:
        item = self._selection.objects[place]
        hulls = [Trimesh(vertices).convex_hull for vertices in (self._cut(item.mesh()) if self._cut else ())]
        return SceneObject(
            code=item.code,
            mesh=f"{OBJECTS}/{item.code}.obj",
            text=object_text(item).encode(),
            pieces={f"{OBJECTS}/{item.code}/piece_{i:02d}.obj": mesh_text(h).encode() for i, h in enumerate(hulls)},
            body=mass_properties(item.mesh().vertices, item.mesh().faces),
        )


def read_mjcf(path: Path | str, *, joint_names: Sequence[str] | None = None) -> GraspSet:
    """Read an export's scenes; those by others say too little.

    Arguments and errors as of :func:`~lgrasp.dataset.exports.formats.read_grasps`.
    """
    folder = open_folder(path, ".xml", "mjcf", joint_names)
    if folder.joint_names is None:
        raise ShardError(f"{path}: no export.json in it; only scenes of a whole export can be read")
    wanted = order_of(folder.joint_names, folder.wanted, path)
    read = [_read(file, folder.joint_names) for file in folder.files]
    joints = np.array([values for values, _ in read])  # (n, 3, K)
    shape = len(read), max(len(seen) for _, seen in read)
    pose, place = np.full((*shape, 7), np.nan), np.full(shape, -1)
    for row, (_, seen) in enumerate(read):
        for column, (code, at) in enumerate(seen):
            pose[row, column], place[row, column] = at, folder.place(code)
    for column in range(shape[1]):
        present = place[:, column] >= 0
        pose[present, column] = folder.object_pose(inverse(pose[present, column]), joints[present, 0])
    return folder.rows(joints[:, :, wanted], pose, place)


def _read(file: Path, joint_names: Sequence[str]) -> tuple[np.ndarray, list[tuple[str, np.ndarray]]]:
    """Joints of grasp, pregrasp and squeeze, shape [3, K]; code and pose in the world of every object."""
    with parsing(file, "a scene of an export", (etree.XMLSyntaxError, *WRONG)):
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

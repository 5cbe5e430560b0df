"""MJCF: one MuJoCo scene per grasp, with keyframes before closing, at the grasp and squeezing."""

from collections.abc import Callable, Sequence
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from lxml import etree
from trimesh import Trimesh
from trimesh.exchange.obj import export_obj

from lgrasp.dataset.exports.folder import GRASPS, HAND, OBJECTS, object_text, write_file
from lgrasp.dataset.exports.hand import HandFrames, hand_files
from lgrasp.dataset.exports.mjcf_scene import Keyframe, MjcfScene, SceneObject
from lgrasp.dataset.exports.reading import GraspSet, ReadObject, make_set, open_folder, order_of
from lgrasp.dataset.exports.selection import Batch, Selection
from lgrasp.errors import ShardError
from lgrasp.geometry.poses import inverse
from lgrasp.grasp.records import ObjectRecord

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
        cut: Convex pieces of an object, vertices [m] of each, shape [V, 3]; without it the hull of its mesh collides.

    Raises:
        PhysicsError: MuJoCo is not installed, or refuses the hand or an object of the first row.
        ShardError: A shard is damaged.
    """

    def __init__(self, selection: Selection, frames: HandFrames, cut: Cut | None = None) -> None:
        self._selection, self._frames, self._cut = selection, frames, cut
        self._hand = {f"{HAND}/{name}": data for name, data in hand_files(selection.hand, selection.shards[0]).items()}
        self._object = cache(self._make_object)
        self._scene = lru_cache(maxsize=16)(self._make_scene)
        index = next(selection.batches()).object_index[0]
        self._scene(tuple(index[index >= 0].tolist()))

    def __call__(self, out: Path, advance: Callable[[int], None]) -> None:
        """Write into the folder of an export.

        Args:
            out: The folder.
            advance: Called with numbers of rows that are done.

        Raises:
            PhysicsError: MuJoCo refuses an object.
            ShardError: A shard is damaged.
            OutputError: The folder cannot be written.
        """
        for place in range(len(self._selection.objects)):
            for name, data in self._object(place).pieces.items():
                write_file(out / name, data)
        for batch in self._selection.batches():
            poses = _in_root(batch, self._frames)  # (n, O, 7)
            joints = [self._frames.all_joints(values) for values in (batch.q, batch.q_pregrasp)]
            for row, number in enumerate(batch.number):
                present = batch.object_index[row] >= 0
                pose, objects = poses[row, present], tuple(batch.object_index[row, present].tolist())
                at, before = ({name: float(v[row]) for name, v in values.items()} for values in joints)
                keys = [
                    Keyframe(_KEYS[0], at, batch.q[row], pose),
                    Keyframe(_KEYS[1], before, batch.q_pregrasp[row], pose),
                    Keyframe(_KEYS[2], at, batch.q_squeeze[row], pose),
                ]
                write_file(out / GRASPS / f"{number:08d}.xml", self._scene(objects).text(keys), flush=False)
                advance(1)

    def _make_scene(self, objects: tuple[int, ...]) -> MjcfScene:
        return MjcfScene(self._hand, self._frames, [self._object(place) for place in objects])

    def _make_object(self, place: int) -> SceneObject:
        item = self._selection.objects[place]
        found = self._cut(item.mesh()) if self._cut else ()
        hulls = [Trimesh(vertices).convex_hull for vertices in found]
        names = [f"{OBJECTS}/{item.code}/piece_{number:02d}.obj" for number in range(len(hulls))]
        return SceneObject(
            code=item.code,
            mesh=f"{OBJECTS}/{item.code}.obj",
            text=object_text(item).encode(),
            pieces={name: _obj(hull) for name, hull in zip(names, hulls, strict=True)},
            volumes=[float(hull.volume) for hull in hulls],
        )


def _obj(mesh: Trimesh) -> bytes:
    return export_obj(mesh, include_normals=False, include_texture=False, digits=9).encode()


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
        q.append(values)
        poses.append([pose for _, pose in seen])
        index.append([folder.place(objects, code, 1.0) for code, _ in seen])
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

"""MJCF: one MuJoCo scene per grasp, with keyframes before closing, at the grasp and squeezing."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache, lru_cache
from itertools import chain, count
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from lxml import etree
from trimesh import Trimesh

from lgrasp.dataset.exports.folder import GRASPS, HAND, OBJECTS, mesh_text, object_text
from lgrasp.dataset.exports.hand import HandFrames, hand_files
from lgrasp.dataset.exports.reading import WRONG, GraspSet, open_folder, order_of
from lgrasp.dataset.exports.selection import Selection
from lgrasp.dataset.files import parsing
from lgrasp.errors import PhysicsError, ShardError, short_reason
from lgrasp.files import write_file
from lgrasp.geometry.poses import inverse
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.object.mass import MassProperties, mass_properties
from lgrasp.runtime.optional import import_mujoco
from lgrasp.simulate.builder import add_drive, set_compiler, set_contact, set_joint, set_mass, set_options
from lgrasp.simulate.protocol import PROTOCOLS

if TYPE_CHECKING:
    import mujoco


class Cut(NamedTuple):
    """Convex pieces, vertices [m] of each, shape [V, 3]."""

    object: Callable[[ObjectRecord], Sequence[np.ndarray]]
    hand: Callable[[HandRecord], Mapping[str, Sequence[np.ndarray]]]
    """Of the links whose collision meshes are no convex solids, link frames."""


_PROTOCOL = PROTOCOLS["fc"]  # the scenes are as this one simulates
_MAX_LINK_OVERLAP = 0.001  # links of the hand that overlap more at the grasp do so because hulls stand for meshes [m]
_HELD_STIFFER = 1000.0  # joints above the base link, which protocol fc welds
_KEYS = ("grasp", "pregrasp", "squeeze")

MJCF_NOTES = """\
grasps/NUMBER.xml  MuJoCo scene of one grasp: mujoco.MjModel.from_xml_path(FILE), then
                   mujoco.mj_resetDataKeyframe(model, data, model.key(NAME).id).

  keyframe grasp     the hand at the grasp, its actuators holding it there
  keyframe pregrasp  the hand before closing
  keyframe squeeze   the hand at the grasp, its actuators pressing on the object
  actuators          one position servo per joint of the list below, named as it is: 5 N m/rad (500 N/m for sliding
                     joints), critically damped. Joints that follow others are tied by equality constraints.
                     Joints that carry link {base}, if there are any, are a thousand times as stiff.
  bodies             the links of hand.urdf under their names; object_PLACE_CODE, free, 0.1 kg. PLACE counts the objects
                     in the hand from 0, in the order in which they were taken; all are where they are at the grasp of
                     the last one, which keyframe pregrasp is before.

The world's frame is that of link {root}, the root link of hand/hand.urdf, which is fixed. No gravity; friction 0.6,
none between links of the hand; all numbers are those of protocol fc of lgrasp simulate. If gravity is turned on, it
pulls the objects alone (gravcomp of the links). Grasps need the scene's cone and impratio: with MuJoCo's own most
objects creep out of the hand.
An object collides with the convex pieces objects/CODE/piece_NN.obj; where there are none, with the hull of its mesh,
which fills its hollows. Meshes of the hand collide with their hulls, links that these would fill with the pieces
hand/pieces/piece_NN.obj; links that overlap at the grasp are kept from colliding with each other.
"""


class Keyframe(NamedTuple):
    """A posture and the targets of the actuators."""

    name: str
    joints: Mapping[str, float]
    """Position of every joint of the hand [rad or m]."""
    targets: Sequence[float]
    """Of the joints of q [rad or m], length K."""
    objects: np.ndarray
    """x y z [m] qw qx qy qz of each object in the world, shape [O, 7]."""


class SceneObject(NamedTuple):
    """A free body. Files by their path in the export, OBJ in metres."""

    code: str
    mesh: str
    text: bytes
    """The file ``mesh``."""
    pieces: Mapping[str, bytes]
    """Convex pieces that collide; none: the hull of the mesh does."""
    body: MassProperties
    """Of the mesh."""


class MjcfScene:
    """A hand, its root link at the origin of the world and fixed, and free objects.

    Args:
        hand: ``hand/hand.urdf`` and the meshes it names, by their path in the export.
        pieces: Files of the convex pieces of links that collide with them in place of their own meshes.
        objects: The objects, in the order of the row.

    Raises:
        PhysicsError: MuJoCo is not installed, or refuses the hand or a mesh.
    """

    def __init__(
        self,
        hand: Mapping[str, bytes],
        pieces: Mapping[str, Mapping[str, bytes]],
        frames: HandFrames,
        objects: Sequence[SceneObject],
    ) -> None:
        mujoco = import_mujoco("mjcf")
        self._mujoco = mujoco
        self._objects = [f"object_{place}_{item.code}" for place, item in enumerate(objects)]
        robot = etree.fromstring(hand["hand/hand.urdf"])
        for mesh in robot.iter("mesh"):
            mesh.set("filename", f"hand/{mesh.get('filename')}")
        for link in robot.iter("link"):
            for element in link.findall("collision") if link.get("name") in pieces else ():
                link.remove(element)
        set_compiler(robot, meshdir="../")  # of the export, seen from the scenes
        files = dict(hand)
        for own in pieces.values():
            files |= own
        for item in objects:
            files |= {item.mesh: item.text, **item.pieces}
        try:
            spec = mujoco.MjSpec.from_string(etree.tostring(robot, encoding="unicode"), assets=files)
            set_options(mujoco, spec, _PROTOCOL)
            for joint in spec.joints:
                set_joint(mujoco, joint, _PROTOCOL)
            for body in spec.bodies[1:]:
                body.gravcomp = 1.0
            for link, own in pieces.items():
                _add_pieces(mujoco, spec, spec.body(link), f"{link} piece", own)
            for name in frames.joint_names:  # controls come in the order of q
                stiffer = _HELD_STIFFER if name in frames.held else 1.0
                add_drive(mujoco, spec, spec.joint(name), _PROTOCOL, stiffer * _PROTOCOL.stiffness)
            for name, item in zip(self._objects, objects, strict=True):
                _add_object(mujoco, spec, name, item)
            for geom in spec.geoms:
                set_contact(geom, _PROTOCOL, 4 if geom.parent.name in self._objects else 1)
            self._model = spec.compile()
            self._xml = spec.to_xml()
        except (ValueError, mujoco.FatalError) as error:
            names = ", ".join(item.code for item in objects)
            raise PhysicsError(f"MuJoCo refuses the hand with {names}: {short_reason(error, 300)}") from None
        self._data = mujoco.MjData(self._model)

    def text(self, keyframes: Sequence[Keyframe]) -> str:
        """The scene as MJCF with keyframes; links that overlap in the first one are kept from colliding."""
        root = etree.fromstring(self._xml.encode(), etree.XMLParser(remove_blank_text=True))
        contact = etree.SubElement(root, "contact")
        for one, other in sorted(self._joined() | self._overlapping(self._qpos(keyframes[0]))):
            etree.SubElement(contact, "exclude", body1=one, body2=other)
        keys = etree.SubElement(root, "keyframe")
        for key in keyframes:
            etree.SubElement(keys, "key", name=key.name, qpos=_text(self._qpos(key)), ctrl=_text(key.targets))
        return etree.tostring(root, pretty_print=True, encoding="unicode")

    def _qpos(self, key: Keyframe) -> np.ndarray:
        qpos = np.zeros(self._model.nq)
        for name, value in key.joints.items():
            qpos[self._model.joint(name).qposadr[0]] = value
        for name, pose in zip(self._objects, key.objects, strict=True):
            start = self._model.joint(name).qposadr[0]
            qpos[start : start + 7] = pose
        return qpos

    def _joined(self) -> set[tuple[str, str]]:
        """Fixed links and those on the first joints after them; MuJoCo itself leaves out all other joined ones."""
        model = self._model
        weld, parent = model.body_weldid, model.body_parentid
        fixed = [b for b in range(model.nbody) if weld[b] == 0]
        first = [b for b in range(model.nbody) if weld[b] != 0 and weld[parent[weld[b]]] == 0]
        names = {b: model.body(b).name for b in (*fixed, *first) if model.body_geomnum[b]}
        pairs = ((names[a], names[b]) for a in fixed for b in first if a in names and b in names)
        return {tuple(sorted(pair)) for pair in pairs if pair[1] not in self._objects}

    def _overlapping(self, qpos: np.ndarray) -> set[tuple[str, str]]:
        """Links of the hand whose hulls overlap."""
        model, data = self._model, self._data
        data.qpos[:] = qpos
        self._mujoco.mj_forward(model, data)
        found = set()
        for contact in data.contact[: data.ncon]:
            pair = tuple(sorted(model.body(model.geom_bodyid[g]).name for g in contact.geom))
            if contact.dist < -_MAX_LINK_OVERLAP and not {*self._objects} & {*pair}:
                found.add(pair)
        return found


def _add_object(mujoco, spec: "mujoco.MjSpec", name: str, item: SceneObject) -> None:
    """The mesh is what is seen and weighs; its pieces collide."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    set_mass(body, _PROTOCOL.mass, item.body.center, item.body.inertia * (_PROTOCOL.mass / item.body.volume))
    spec.add_mesh(name=name, file=item.mesh)
    shape = {"type": mujoco.mjtGeom.mjGEOM_MESH}
    if not item.pieces:
        body.add_geom(name=name, meshname=name, **shape)
        return
    body.add_geom(name=name, meshname=name, contype=0, conaffinity=0, group=2, **shape)
    _add_pieces(mujoco, spec, body, name, item.pieces, group=3)


def _add_pieces(mujoco, spec: "mujoco.MjSpec", body: Any, name: str, files: Iterable[str], **options: Any) -> None:
    for number, file in enumerate(files):
        piece = f"{name}_{number}"
        spec.add_mesh(name=piece, file=file)
        body.add_geom(name=piece, meshname=piece, type=mujoco.mjtGeom.mjGEOM_MESH, **options)


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)


class MjcfWriter:
    """Writes ``grasps/NUMBER.xml`` for every row, numbered over the whole export.

    Args:
        cut: Cuts objects and the hand; without it the hulls of their meshes collide.

    Raises:
        PhysicsError: MuJoCo is not installed, or refuses the hand or an object, of the first row at once.
        ShardError: A shard is damaged.
        OutputError: The folder cannot be written.
    """

    def __init__(self, selection: Selection, frames: HandFrames, cut: Cut | None = None) -> None:
        import_mujoco("mjcf")  # before objects are cut, which takes long
        self._selection, self._frames, self._cut = selection, frames, cut
        self._hand = {f"{HAND}/{name}": data for name, data in hand_files(selection.hand, selection.shards[0]).items()}
        number = count()
        self._pieces = {
            link: {f"{HAND}/pieces/piece_{next(number):02d}.obj": _hull_text(vertices) for vertices in own}
            for link, own in (cut.hand(selection.hand) if cut else {}).items()
        }
        self._object = cache(self._make_object)
        self._scene = lru_cache(maxsize=16)(
            lambda objects: MjcfScene(self._hand, self._pieces, frames, [*map(self._object, objects)])
        )
        index = next(selection.batches()).object_index[0]
        self._scene(tuple(index[index >= 0].tolist()))

    def __call__(self, out: Path, advance: Callable[[int], None]) -> None:
        """Write into the folder of an export, calling ``advance`` with numbers of rows that are done."""
        frames = self._frames
        objects = (self._object(place).pieces for place in range(len(self._selection.objects)))
        for name, data in chain.from_iterable(pieces.items() for pieces in (*self._pieces.values(), *objects)):
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
        pieces = self._cut.object(item.mesh()) if self._cut else ()
        return SceneObject(
            code=item.code,
            mesh=f"{OBJECTS}/{item.code}.obj",
            text=object_text(item).encode(),
            pieces={f"{OBJECTS}/{item.code}/piece_{i:02d}.obj": _hull_text(v) for i, v in enumerate(pieces)},
            body=mass_properties(item.mesh().vertices, item.mesh().faces),
        )


def _hull_text(vertices: np.ndarray) -> bytes:
    return mesh_text(Trimesh(vertices).convex_hull).encode()


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

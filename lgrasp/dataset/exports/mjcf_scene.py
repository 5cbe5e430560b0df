"""A MuJoCo scene of a hand and objects from the files of an export."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from lxml import etree

from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.errors import PhysicsError, short_reason
from lgrasp.object.mass import MassProperties
from lgrasp.runtime.optional import import_mujoco
from lgrasp.simulate.builder import (
    add_drive,
    set_compiler,
    set_contact,
    set_joint,
    set_mass,
    set_options,
)
from lgrasp.simulate.protocol import PROTOCOLS

if TYPE_CHECKING:
    import mujoco

_PROTOCOL = PROTOCOLS["fc"]  # the scenes are as this one simulates
_MAX_LINK_OVERLAP = 0.001  # links of the hand that overlap more at the grasp do so because hulls stand for meshes [m]


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
        frames: The hand.
        objects: The objects, in the order of the row.

    Raises:
        PhysicsError: MuJoCo is not installed, or refuses the hand or a mesh.
    """

    def __init__(self, hand: Mapping[str, bytes], frames: HandFrames, objects: Sequence[SceneObject]) -> None:
        mujoco = import_mujoco("mjcf")
        self._mujoco = mujoco
        self._objects = [f"object_{place}_{item.code}" for place, item in enumerate(objects)]
        robot = etree.fromstring(hand["hand/hand.urdf"])
        for mesh in robot.iter("mesh"):
            mesh.set("filename", f"hand/{mesh.get('filename')}")
        set_compiler(robot, meshdir="../")  # of the export, seen from the scenes
        files = dict(hand)
        for item in objects:
            files |= {item.mesh: item.text, **item.pieces}
        try:
            spec = mujoco.MjSpec.from_string(etree.tostring(robot, encoding="unicode"), assets=files)
            set_options(mujoco, spec, _PROTOCOL)
            for joint in spec.joints:
                set_joint(mujoco, joint, _PROTOCOL)
            for name in frames.joint_names:  # controls come in the order of q
                add_drive(mujoco, spec, spec.joint(name), _PROTOCOL, _PROTOCOL.stiffness)
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
    for number, file in enumerate(item.pieces):
        piece = f"{name}_{number}"
        spec.add_mesh(name=piece, file=file)
        body.add_geom(name=piece, meshname=piece, group=3, **shape)


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)

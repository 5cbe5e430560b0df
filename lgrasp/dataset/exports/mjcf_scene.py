"""A MuJoCo scene of a hand and objects from the files of an export."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from lxml import etree

from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.errors import PhysicsError

if TYPE_CHECKING:
    import mujoco

_COMPILER = {"strippath": "false", "discardvisual": "true", "balanceinertia": "true", "fusestatic": "false"}
_COMPILER |= {"meshdir": "../"}  # of the export, seen from the scenes
_TIMESTEP = 0.004  # [s]
_STIFFNESS, _ARMATURE = 5.0, 2.0e-4  # of the drives of revolute joints [N m/rad], [kg m^2]
_LEVER = 0.1  # a sliding joint is like a revolute one at this arm [m]
_LEAST_MASS, _LEAST_INERTIA = 1.0e-3, 1.0e-7  # [kg], [kg m^2] of links whose URDF gives less
_OBJECT_MASS = 0.1  # [kg]
_FRICTION = (0.6, 0.02, 0.0001)
_DEEP = 0.001  # links of the hand that overlap more at the grasp do so because hulls stand for meshes [m]


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
    volumes: Sequence[float]
    """Of the pieces [m^3]."""


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
        try:
            import mujoco
        except ImportError:
            raise PhysicsError('mjcf needs MuJoCo, which is not installed: pip install "lgrasp[sim]"') from None
        self._mujoco = mujoco
        self._objects = [f"object_{place}_{item.code}" for place, item in enumerate(objects)]
        files = dict(hand)
        for item in objects:
            files |= {item.mesh: item.text, **item.pieces}
        try:
            spec = _hand_spec(mujoco, files)
            for name, item in zip(self._objects, objects, strict=True):
                _add_object(mujoco, spec, name, item)
            _finish(mujoco, spec, frames.joint_names)
            self._model = spec.compile()
            self._xml = spec.to_xml()
        except (ValueError, mujoco.FatalError) as error:
            names = ", ".join(item.code for item in objects)
            reason = " ".join(str(error).split())[:300]
            raise PhysicsError(f"MuJoCo refuses the hand with {names}: {reason}") from None
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
            if contact.dist < -_DEEP and not {*self._objects} & {*pair}:
                found.add(pair)
        return found


def _hand_spec(mujoco, files: dict[str, bytes]) -> "mujoco.MjSpec":
    robot = etree.fromstring(files["hand/hand.urdf"])
    for mesh in robot.iter("mesh"):
        mesh.set("filename", f"hand/{mesh.get('filename')}")
    for old in robot.findall("mujoco"):
        robot.remove(old)
    etree.SubElement(etree.SubElement(robot, "mujoco"), "compiler", _COMPILER)
    return mujoco.MjSpec.from_string(etree.tostring(robot, encoding="unicode"), assets=files)


def _add_object(mujoco, spec: "mujoco.MjSpec", name: str, item: SceneObject) -> None:
    """The mesh is what is seen; its pieces collide and weigh."""
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    spec.add_mesh(name=name, file=item.mesh)
    shape = {"type": mujoco.mjtGeom.mjGEOM_MESH}
    if not item.pieces:
        body.add_geom(name=name, meshname=name, mass=_OBJECT_MASS, **shape)
        return
    body.add_geom(name=name, meshname=name, mass=0, contype=0, conaffinity=0, group=2, **shape)
    for number, (file, volume) in enumerate(zip(item.pieces, item.volumes, strict=True)):
        piece = f"{name}_{number}"
        spec.add_mesh(name=piece, file=file)
        mass = _OBJECT_MASS * volume / sum(item.volumes)
        body.add_geom(name=piece, meshname=piece, mass=mass, group=3, **shape)


def _finish(mujoco, spec: "mujoco.MjSpec", joint_names: Sequence[str]) -> None:
    """No gravity, friction, position actuators on the joints of q."""
    spec.option.timestep = _TIMESTEP
    spec.option.gravity = [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio, spec.option.noslip_iterations = 10, 2
    spec.compiler.boundmass, spec.compiler.boundinertia = _LEAST_MASS, _LEAST_INERTIA
    for geom in spec.geoms:
        geom.friction, geom.condim = _FRICTION, 4
    for joint in spec.joints:
        if joint.type != mujoco.mjtJoint.mjJNT_FREE:
            joint.armature = _ARMATURE / _lever(mujoco, joint) ** 2
    for name in joint_names:  # controls come in the order of q
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=_STIFFNESS / _lever(mujoco, spec.joint(name)) ** 2, dampratio=1.0)


def _lever(mujoco, joint: "mujoco.MjsJoint") -> float:
    return _LEVER if joint.type == mujoco.mjtJoint.mjJNT_SLIDE else 1.0


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)

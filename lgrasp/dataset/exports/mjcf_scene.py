"""A MuJoCo scene of a hand and objects from the files of an export."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from lxml import etree

from lgrasp.dataset.exports.hand import HandFrames
from lgrasp.errors import ConfigError, ShardError

if TYPE_CHECKING:
    import mujoco

__all__ = ["Keyframe", "Scene"]

_COMPILER = {"strippath": "false", "discardvisual": "true", "balanceinertia": "true", "fusestatic": "false"}
_STIFFNESS = {"hinge": 5.0, "slide": 500.0}  # of the position actuators [N m/rad, N/m]
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


class Scene:
    """A hand, its root link at the origin of the world and fixed, and free objects.

    Args:
        files: ``hand/hand.urdf``, the meshes it names and those of the objects, by their path in the export.
        frames: The hand.
        meshes: Path of the mesh of each object.
        codes: Name of each object.
        up: Path from the folder of the scene to that of the export.

    Raises:
        ConfigError: MuJoCo is not installed.
        ShardError: MuJoCo refuses the hand or a mesh.
    """

    def __init__(
        self, files: Mapping[str, bytes], frames: HandFrames, meshes: Sequence[str], codes: Sequence[str], up: str
    ) -> None:
        try:
            import mujoco
        except ImportError:
            raise ConfigError("--to mjcf needs MuJoCo: pip install 'lgrasp[sim]'") from None
        self._mujoco = mujoco
        self._objects = [_object_body(place, code) for place, code in enumerate(codes)]
        try:
            spec = _hand_spec(mujoco, files, up)
            for name, mesh in zip(self._objects, meshes, strict=True):
                _add_object(mujoco, spec, name, mesh)
            _finish(mujoco, spec, frames.joint_names)
            self._model = spec.compile()
            self._xml = spec.to_xml()
        except (ValueError, mujoco.FatalError) as error:
            raise ShardError(f"MuJoCo refuses the hand or an object: {' '.join(str(error).split())[:300]}") from None
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


def _object_body(place: int, code: str) -> str:
    """Name of the body, the joint and the mesh of the object at a place of a row."""
    return f"object_{place}_{code}"


def _hand_spec(mujoco, files: Mapping[str, bytes], up: str) -> "mujoco.MjSpec":
    robot = etree.fromstring(files["hand/hand.urdf"])
    for mesh in robot.iter("mesh"):
        mesh.set("filename", f"hand/{mesh.get('filename')}")
    for old in robot.findall("mujoco"):
        robot.remove(old)
    etree.SubElement(etree.SubElement(robot, "mujoco"), "compiler", {**_COMPILER, "meshdir": up})
    return mujoco.MjSpec.from_string(etree.tostring(robot, encoding="unicode"), assets=dict(files))


def _add_object(mujoco, spec: "mujoco.MjSpec", name: str, mesh: str) -> None:
    spec.add_mesh(name=name, file=mesh)
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    body.add_geom(name=name, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, mass=_OBJECT_MASS)


def _finish(mujoco, spec: "mujoco.MjSpec", joint_names: Sequence[str]) -> None:
    """No gravity, friction, position actuators on the joints of q."""
    spec.option.timestep = 0.002
    spec.option.gravity = [0, 0, 0]
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    for geom in spec.geoms:
        geom.friction, geom.condim = _FRICTION, 4
    for name in joint_names:
        joint = spec.joint(name)
        kind = "slide" if joint.type == mujoco.mjtJoint.mjJNT_SLIDE else "hinge"
        actuator = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=_STIFFNESS[kind], dampratio=1.0)


def _text(values: Sequence[float] | np.ndarray) -> str:
    return " ".join(f"{value:.9g}" for value in values)

"""Scene and protocol -> a MuJoCo model, with the tables that map rows of a shard to its state."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from lgrasp.errors import PhysicsError
from lgrasp.hand.geometry import Piece
from lgrasp.physics.protocol import Load, Protocol
from lgrasp.physics.scene import HandSolids, Scene
from lgrasp.physics.urdf import bare_urdf, joint_ends, welded_joints

__all__ = ["Model", "build_model", "import_mujoco"]

OBJECT = "lgrasp object"
_POSTURES = 200
_NEARLY = 0.95  # of all postures; links that touch so often are left to touch
_LEAST_MASS, _LEAST_INERTIA = 1.0e-3, 1.0e-7  # [kg], [kg m^2] of links whose URDF gives less


@dataclass(frozen=True)
class Model:
    """A compiled scene; K columns of q, J joints of the hand in MuJoCo, B bodies."""

    mujoco: Any
    """MjModel"""
    mujoco_near: Any
    """MjModel in which hand and object touch within 1 mm."""
    protocol: Protocol
    load: Load
    joint_address: np.ndarray
    """(J,) place of each joint in qpos."""
    joint_matrix: np.ndarray
    """(J, K): joint positions = joint_matrix @ q + joint_offset, mimic joints included."""
    joint_offset: np.ndarray
    """(J,) [rad or m]"""
    columns: np.ndarray
    """Columns of q in the order of the controls."""
    held: dict[str, tuple[int, float]]
    """Joints above the base link: column and the value at which they are welded [rad or m]."""
    object_address: int
    """Place of the object's seven numbers in qpos."""
    object_body: int
    base_body: int
    link_body: np.ndarray
    """(L,) body of each of the shard's links, -1: none."""
    hand_bodies: np.ndarray
    """(B,) bool: links of the hand."""
    center: np.ndarray
    """(3,) centre of mass in the object's frame [m]."""


def import_mujoco() -> Any:
    """The module mujoco.

    Raises:
        PhysicsError: it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise PhysicsError('physics needs MuJoCo, which is not installed: pip install "lgrasp[sim]"') from None
    return mujoco


def build_model(scene: Scene, protocol: Protocol, q: np.ndarray) -> Model:
    """Compile a scene.

    Args:
        q: one row of joint positions (K,) [rad or m]; joints above the base link are welded there.

    Raises:
        PhysicsError: MuJoCo is missing or refuses the hand; its reason is in the message.
    """
    mujoco = import_mujoco()
    hand = scene.hand
    held = {
        name: (hand.joint_names.index(name), float(q[hand.joint_names.index(name)]))
        for name in welded_joints(hand.urdf, hand.base_link)
        if name in hand.joint_names
    }
    load = protocol.load(scene.object.volume)
    try:
        spec = mujoco.MjSpec.from_string(bare_urdf(hand.urdf, {name: value for name, (_, value) in held.items()}))
        _set_options(mujoco, spec, protocol)
        _add_pieces(mujoco, spec, hand)
        _add_drives(mujoco, spec, protocol, load)
        _add_object(mujoco, spec, scene, load)
        for geom in spec.geoms:  # the larger condim of a pair counts: links slide on links without friction
            geom.friction = [protocol.friction, protocol.torsion, 1.0e-4]
            geom.condim = 4 if geom.parent.name == OBJECT else 1
        _exclude_neighbours(spec, hand)
        first = spec.compile()
        for a, b in _always_touching(mujoco, first):
            spec.add_exclude(bodyname1=first.body(a).name, bodyname2=first.body(b).name)
        model = spec.compile()
        for geom in spec.body(OBJECT).geoms:
            geom.margin = 1.0e-3
        near = spec.compile()
    except (ValueError, KeyError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise PhysicsError(f"MuJoCo refuses hand '{hand.name}' with object '{scene.object.name}': {reason}") from None
    return _tables(mujoco, model, near, scene, protocol, load, held)


def _set_options(mujoco: Any, spec: Any, protocol: Protocol) -> None:
    option = spec.option
    option.timestep = protocol.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.gravity = [0, 0, 0]
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.noslip_iterations = protocol.noslip
    option.impratio = protocol.impratio
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    spec.compiler.boundmass = _LEAST_MASS
    spec.compiler.boundinertia = _LEAST_INERTIA


def _add_pieces(mujoco: Any, spec: Any, hand: HandSolids) -> None:
    for link, pieces in hand.pieces.items():
        body = spec.body(link)
        if body is None and pieces:
            raise PhysicsError(f"MuJoCo does not know link '{link}' of hand '{hand.name}'")
        for number, piece in enumerate(pieces):
            _add_piece(mujoco, spec, body, piece, f"{link} {number}")


def _add_piece(mujoco: Any, spec: Any, body: Any, piece: Piece, name: str) -> None:
    if len(piece.planes):
        _add_hull(mujoco, spec, body, _inflated(piece), name)
    elif len(piece.vertices) == 1:
        size = [piece.radius, 0, 0]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=piece.vertices[0])
    else:
        ends = np.concatenate([piece.vertices[0], piece.vertices[-1]])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[piece.radius, 0, 0], fromto=ends)


def _inflated(piece: Piece) -> np.ndarray:
    """Vertices (V, 3) of a hull grown by the piece's radius, a fraction of a millimetre."""
    if piece.radius == 0.0:
        return piece.vertices
    hull = ConvexHull(piece.vertices)
    normals = np.zeros_like(piece.vertices)
    for face in hull.simplices.T:
        np.add.at(normals, face, hull.equations[:, :3])
    return piece.vertices + piece.radius * normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-9)[:, None]


def _add_hull(mujoco: Any, spec: Any, body: Any, vertices: np.ndarray, name: str) -> None:
    try:
        ConvexHull(vertices)
    except QhullError:  # a sliver
        return
    mesh = spec.add_mesh(name=name, uservert=np.asarray(vertices, float).ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def _add_drives(mujoco: Any, spec: Any, protocol: Protocol, load: Load) -> None:
    """Position control of every joint that follows no other."""
    followers = {e.name1 for e in spec.equalities}
    for joint in spec.joints:
        sliding = joint.type == mujoco.mjtJoint.mjJNT_SLIDE
        scale = protocol.lever**-2 if sliding else 1.0
        joint.armature = protocol.armature * scale
        joint.damping = np.zeros_like(joint.damping)
        joint.frictionloss = 0.0
        if joint.name not in followers:
            drive = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            drive.set_to_position(kp=load.stiffness * scale, dampratio=protocol.damping_ratio)


def _add_object(mujoco: Any, spec: Any, scene: Scene, load: Load) -> None:
    solid = scene.object
    body = spec.worldbody.add_body(name=OBJECT)
    body.add_freejoint()
    for number, vertices in enumerate(solid.pieces):
        _add_hull(mujoco, spec, body, vertices, f"{OBJECT} {number}")
    inertia = solid.inertia * (load.mass / solid.volume)
    body.mass = load.mass
    body.ipos = solid.center
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.explicitinertial = True


def _exclude_neighbours(spec: Any, hand: HandSolids) -> None:
    """Links joined by a joint do not collide; MuJoCo forgets those joined to what is welded to the world."""
    for parent, child in joint_ends(hand.urdf).values():
        if spec.body(parent) is not None and spec.body(child) is not None:
            spec.add_exclude(bodyname1=parent, bodyname2=child)


def _always_touching(mujoco: Any, model: Any) -> list[tuple[int, int]]:
    """Pairs of the hand's bodies whose pieces touch in nearly every posture; a function of the hand only."""
    data = mujoco.MjData(model)
    free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    joints = np.flatnonzero(~free)
    bounded = model.jnt_limited[joints].astype(bool)[:, None]
    limits = np.where(bounded, model.jnt_range[joints], [-np.pi, np.pi])
    rng = np.random.default_rng(0)
    count: dict[tuple[int, int], int] = {}
    away = model.jnt_qposadr[free][0]
    for _ in range(_POSTURES):
        data.qpos[model.jnt_qposadr[joints]] = rng.uniform(limits[:, 0], limits[:, 1])
        data.qpos[away : away + 7] = [100, 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        touching = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        for a, b in {(int(a), int(b)) for a, b in touching[data.contact.dist < 0]}:
            count[a, b] = count.get((a, b), 0) + 1
    return sorted(pair for pair, n in count.items() if n > _NEARLY * _POSTURES)


def _tables(
    mujoco: Any,
    model: Any,
    near: Any,
    scene: Scene,
    protocol: Protocol,
    load: Load,
    held: dict[str, tuple[int, float]],
) -> Model:
    hand = scene.hand
    column = {name: k for k, name in enumerate(hand.joint_names)}
    joints = np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE)
    follows = {
        int(model.eq_obj1id[e]): (int(model.eq_obj2id[e]), *model.eq_data[e, :2])
        for e in range(model.neq)
        if model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT
    }
    matrix, offset = np.zeros((len(joints), len(column))), np.zeros(len(joints))
    for row, joint in enumerate(joints):
        factor, at = 1.0, int(joint)
        while at in follows:  # a mimic joint: offset + multiplier x its source
            source, shift, multiplier = follows[at]
            offset[row] += factor * shift
            factor, at = factor * multiplier, source
        if model.joint(at).name in column:
            matrix[row, column[model.joint(at).name]] = factor
    driven = [model.actuator(i).name for i in range(model.nu)]
    body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, OBJECT)
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, hand.base_link)
    return Model(
        mujoco=model,
        mujoco_near=near,
        protocol=protocol,
        load=load,
        joint_address=model.jnt_qposadr[joints].copy(),
        joint_matrix=matrix,
        joint_offset=offset,
        columns=np.array([column.get(name, -1) for name in driven]),
        held=held,
        object_address=int(model.jnt_qposadr[model.body_jntadr[body]]),
        object_body=body,
        base_body=base,
        link_body=np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in hand.link_names]),
        hand_bodies=np.arange(model.nbody) != body,
        center=scene.object.center,
    )

"""Scene and protocol -> MuJoCo's specification of them: bodies, solids, drives, options."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from lgrasp.errors import PhysicsError
from lgrasp.hand.geometry import Piece
from lgrasp.simulate.protocol import Load, Protocol
from lgrasp.simulate.scene import HandSolids
from lgrasp.simulate.solid import Solid
from lgrasp.simulate.urdf import bare_urdf, joint_ends

OBJECT = "lgrasp object"
"""Begins the name of every object's body; its number follows."""

_POSTURES = 200
_NEARLY = 0.95  # of all postures; links that touch so often are left to touch
_LEAST_MASS, _LEAST_INERTIA = 1.0e-3, 1.0e-7  # [kg], [kg m^2] of links whose URDF gives less


def assemble(
    mujoco: Any,
    hand: HandSolids,
    objects: Sequence[Solid],
    protocol: Protocol,
    held: Mapping[str, float],
) -> Any:
    """The MjSpec of a hand with some objects; the drives are as stiff as the object needs that needs the stiffest.

    Args:
        mujoco: the module.
        objects: one may be there twice.
        held: joints above the base link and where they are welded [rad or m].

    Raises:
        ValueError: MuJoCo refuses the hand.
    """
    loads = [protocol.load(solid.volume) for solid in objects]
    spec = mujoco.MjSpec.from_string(bare_urdf(hand.urdf, held))
    _set_options(mujoco, spec, protocol)
    _add_pieces(mujoco, spec, hand)
    _add_drives(mujoco, spec, protocol, max(load.stiffness for load in loads))
    for number, (solid, load) in enumerate(zip(objects, loads, strict=True)):
        _add_object(mujoco, spec, f"{OBJECT} {number}", solid, load)
    for geom in spec.geoms:  # the larger condim of a pair counts: links slide on links without friction
        geom.friction = [protocol.friction, protocol.torsion, 1.0e-4]
        geom.condim = 4 if geom.parent.name.startswith(OBJECT) else 1
    _exclude_neighbours(spec, hand)
    model = spec.compile()
    for a, b in _always_touching(mujoco, model):
        spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)
    return spec


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
        add_hull(mujoco, spec, body, _inflated(piece), name)
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


def add_hull(mujoco: Any, spec: Any, body: Any, vertices: np.ndarray, name: str) -> None:
    """Give a body of a MjSpec the convex hull of vertices (V, 3) [m] to collide with; a sliver is left out."""
    try:
        ConvexHull(vertices)
    except QhullError:
        return
    mesh = spec.add_mesh(name=name, uservert=np.asarray(vertices, float).ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)


def _add_drives(mujoco: Any, spec: Any, protocol: Protocol, stiffness: float) -> None:
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
            drive.set_to_position(kp=stiffness * scale, dampratio=protocol.damping_ratio)


def _add_object(mujoco: Any, spec: Any, name: str, solid: Solid, load: Load) -> None:
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint()
    for number, vertices in enumerate(solid.pieces):
        add_hull(mujoco, spec, body, vertices, f"{name} {number}")
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
    away = model.jnt_qposadr[free]
    for _ in range(_POSTURES):
        data.qpos[model.jnt_qposadr[joints]] = rng.uniform(limits[:, 0], limits[:, 1])
        for number, address in enumerate(away):
            data.qpos[address : address + 7] = [100 * (number + 1), 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        touching = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        for a, b in {(int(a), int(b)) for a, b in touching[data.contact.dist < 0]}:
            count[a, b] = count.get((a, b), 0) + 1
    return sorted(pair for pair, n in count.items() if n > _NEARLY * _POSTURES)

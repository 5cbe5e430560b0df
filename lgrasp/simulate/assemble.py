"""Scene and protocol -> MuJoCo's specification of them: bodies, solids, drives, options."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from lxml import etree
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from lgrasp.errors import PhysicsError
from lgrasp.hand.drafting.elements import set_origin
from lgrasp.hand.pairs import ALMOST_ALWAYS
from lgrasp.hand.piece import Piece
from lgrasp.hand.urdf import numbers, parse_robot
from lgrasp.simulate.builder import (
    add_drive,
    add_hull,
    add_solid,
    add_table,
    set_compiler,
    set_contact,
    set_joint,
    set_options,
)
from lgrasp.simulate.protocol import Protocol
from lgrasp.simulate.scene import HandSolids
from lgrasp.simulate.solid import Solid


def bare_urdf(text: str, held: Mapping[str, float]) -> str:
    """A URDF text without visual and collision elements, and with one inertia a link, for MuJoCo.

    Args:
        held: joints that become fixed, and where [rad or m].

    Raises:
        HandError: not XML, or no <robot>.
    """
    tree, _ = parse_robot(Path("hand.urdf"), text.encode())
    for link in tree.iterfind("link"):
        for element in [*link.iterfind("visual"), *link.iterfind("collision"), *link.findall("inertial")[1:]]:
            link.remove(element)
    set_compiler(tree)
    for joint in tree.iterfind("joint"):
        if joint.get("name") in held and joint.get("type") != "fixed":
            _weld(joint, held[joint.get("name", "")])
    return etree.tostring(tree, encoding="unicode")


def _weld(joint: etree._Element, value: float) -> None:
    """Fix a joint where it is: its motion becomes part of its origin."""
    origin, axis = joint.find("origin"), numbers(joint.find("axis"), "xyz", "1 0 0")
    xyz, turn = numbers(origin, "xyz", "0 0 0"), Rotation.from_euler("xyz", numbers(origin, "rpy", "0 0 0"))
    step = axis / np.linalg.norm(axis) * value
    if joint.get("type") == "prismatic":
        xyz = xyz + turn.apply(step)
    else:
        turn = turn * Rotation.from_rotvec(step)
    for element in (*joint.iterfind("origin"), *joint.iterfind("mimic")):
        joint.remove(element)
    set_origin(joint, xyz, turn)
    joint.set("type", "fixed")


OBJECT = "lgrasp object"
"""Begins the name of every object's body; its number follows."""
TABLE = "lgrasp table"
"""Names the body of the table, where there is one."""

_COUPLING = (0.99, 0.999)  # impedance of coupled joints: with MuJoCo's own they give way more than the drive
_SAMPLED_POSTURES = 200


def assemble(
    mujoco: Any, hand: HandSolids, objects: Sequence[Solid], protocol: Protocol, held: Mapping[str, float]
) -> Any:
    """The MjSpec of a hand with some objects; the drives are as stiff as the object needs that needs the stiffest.

    Args:
        objects: one may be there twice.
        held: joints above the base link and where they are welded [rad or m].

    Raises:
        ValueError: MuJoCo refuses the hand.
    """
    loads = [protocol.load(solid.volume) for solid in objects]
    spec = mujoco.MjSpec.from_string(bare_urdf(hand.record.urdf, held))
    set_options(mujoco, spec, protocol)
    for link, pieces in hand.pieces.items():
        body = spec.body(link)
        if body is None and pieces:
            raise PhysicsError(f"MuJoCo does not know link '{link}' of hand '{hand.record.name}'")
        for number, piece in enumerate(pieces):
            _add_piece(mujoco, spec, body, piece, f"{link} {number}")
    for equality in spec.equalities:
        equality.solref, equality.solimp[:2] = [2.0 * protocol.timestep, 1.0], _COUPLING
    followers = {equality.name1 for equality in spec.equalities}
    for joint in spec.joints:
        set_joint(mujoco, joint, protocol)
        if joint.name not in followers:
            add_drive(mujoco, spec, joint, protocol, max(load.stiffness for load in loads))
    for number, (solid, load) in enumerate(zip(objects, loads, strict=True)):
        inertia = solid.inertia * (load.mass / solid.volume)
        add_solid(mujoco, spec, f"{OBJECT} {number}", solid, load.mass, inertia)
    for geom in spec.geoms:  # links slide on links without friction
        set_contact(geom, protocol, 4 if geom.parent.name.startswith(OBJECT) else 1)
    if protocol.table:
        add_table(mujoco, spec, TABLE, protocol)
    _exclude_neighbours(spec, hand)
    model = spec.compile()
    for a, b in _always_touching(mujoco, model):
        spec.add_exclude(bodyname1=model.body(a).name, bodyname2=model.body(b).name)
    return spec


def _add_piece(mujoco: Any, spec: Any, body: Any, piece: Piece, name: str) -> None:
    if len(piece.planes):
        add_hull(mujoco, spec, body, inflated(piece), name)
    elif len(piece.vertices) == 1:
        size = [piece.radius, 0, 0]
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=size, pos=piece.vertices[0])
    else:
        ends = np.concatenate([piece.vertices[0], piece.vertices[-1]])
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_CAPSULE, size=[piece.radius, 0, 0], fromto=ends)


def inflated(piece: Piece) -> np.ndarray:
    """Vertices (V, 3) of a hull that stands for the piece: its own grown by its radius, a fraction of a millimetre; of
    balls and capsules some on their surface."""
    if piece.radius == 0.0:
        return piece.vertices
    if not len(piece.planes):
        return (piece.vertices[:, None] + trimesh.creation.icosphere(2, piece.radius).vertices).reshape(-1, 3)
    hull = ConvexHull(piece.vertices)
    normals = np.zeros_like(piece.vertices)
    for face in hull.simplices.T:
        np.add.at(normals, face, hull.equations[:, :3])
    return piece.vertices + piece.radius * normals / np.maximum(np.linalg.norm(normals, axis=1), 1e-9)[:, None]


def _exclude_neighbours(spec: Any, hand: HandSolids) -> None:
    """Links joined by a joint do not collide; MuJoCo forgets those joined to what is welded to the world."""
    for joint in hand.joints:
        if spec.body(joint.parent) is not None and spec.body(joint.child) is not None:
            spec.add_exclude(bodyname1=joint.parent, bodyname2=joint.child)


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
    for _ in range(_SAMPLED_POSTURES):
        data.qpos[model.jnt_qposadr[joints]] = rng.uniform(limits[:, 0], limits[:, 1])
        for number, address in enumerate(away):
            data.qpos[address : address + 7] = [100 * (number + 1), 0, 0, 1, 0, 0, 0]
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        touching = np.sort(model.geom_bodyid[data.contact.geom], axis=1)
        for a, b in {(int(a), int(b)) for a, b in touching[data.contact.dist < 0]}:
            count[a, b] = count.get((a, b), 0) + 1
    return sorted(pair for pair, n in count.items() if n > ALMOST_ALWAYS * _SAMPLED_POSTURES)

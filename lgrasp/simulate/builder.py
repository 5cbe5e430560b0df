"""Parts of every MuJoCo scene: options, contacts, drives and free bodies."""

from typing import Any

import numpy as np
from lxml import etree
from scipy.spatial import ConvexHull, QhullError

from lgrasp.math.constants import LEAST_INERTIA, LEAST_MASS
from lgrasp.simulate.protocol import Physics, Protocol
from lgrasp.simulate.solid import LEAST_VOLUME, Solid

ROLLING = 1.0e-4
"""Rolling friction [m]; contacts of dimension 4 have none."""

_TABLE_HALF, _TABLE_THICKNESS = 1.0, 0.2  # [m]
_TABLE_AWAY = 100.0  # [m]
_TABLE_MASS = 100.0  # [kg], and [kg m^2]: what presses on it does not move it within one step

_COMPILER = {"strippath": "false", "discardvisual": "true", "balanceinertia": "true", "fusestatic": "false"}


def set_compiler(robot: etree._Element, **more: str) -> None:
    """Replace what a URDF tells MuJoCo's compiler by what all our scenes tell it, and ``more``."""
    for element in list(robot.iterfind("mujoco")):
        robot.remove(element)
    etree.SubElement(etree.SubElement(robot, "mujoco"), "compiler", _COMPILER | more)


def set_options(mujoco: Any, spec: Any, physics: Physics, *, weightless: bool = True) -> None:
    """Time step, integrator and contact solver of an MjSpec, and the least mass and inertia of its bodies."""
    option = spec.option
    option.timestep = physics.timestep
    option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.noslip_iterations = physics.noslip
    option.impratio = physics.impratio
    option.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
    if weightless:
        option.gravity = [0, 0, 0]
    spec.compiler.boundmass = LEAST_MASS
    spec.compiler.boundinertia = LEAST_INERTIA


def set_contact(geom: Any, physics: Physics, dimension: int, rolling: float = ROLLING) -> None:
    """How a geom touches: friction of ``dimension`` 1 (none), 4 (slides, twists) or 6 (rolls); of two geoms the larger
    dimension counts."""
    geom.friction = [physics.friction, physics.torsion, rolling]
    geom.condim = dimension


def set_joint(mujoco: Any, joint: Any, protocol: Protocol) -> None:
    """Inertia of a joint's drive; no friction or damping of its own."""
    joint.armature = protocol.armature * _scale(mujoco, joint, protocol)
    joint.damping = np.zeros_like(joint.damping)
    joint.frictionloss = 0.0


def add_drive(mujoco: Any, spec: Any, joint: Any, protocol: Protocol, stiffness: float) -> None:
    """Position control of a joint, as stiff as given if it is revolute [N m/rad]."""
    drive = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    drive.set_to_position(kp=stiffness * _scale(mujoco, joint, protocol), dampratio=protocol.damping_ratio)


def _scale(mujoco: Any, joint: Any, protocol: Protocol) -> float:
    """Stiffness or inertia of a joint over that of a revolute one."""
    return protocol.lever**-2 if joint.type == mujoco.mjtJoint.mjJNT_SLIDE else 1.0


def add_solid(mujoco: Any, spec: Any, name: str, solid: Solid, mass: float, inertia: np.ndarray) -> None:
    """A free body that collides by its convex pieces; its frame is at its centre of mass, however far that is from the
    object's own.

    Args:
        mass: [kg]
        inertia: about the centre of mass, (3, 3) [kg m^2].
    """
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint()
    for number, vertices in enumerate(solid.pieces):
        add_hull(mujoco, spec, body, vertices - solid.center, f"{name} {number}")
    set_mass(body, mass, np.zeros(3), inertia)


def set_mass(body: Any, mass: float, center: np.ndarray, inertia: np.ndarray) -> None:
    """Mass [kg], centre of mass (3,) [m] and inertia about it (3, 3) [kg m^2] of a body, whatever it collides with."""
    body.mass = mass
    body.ipos = center
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    body.explicitinertial = True


def add_table(mujoco: Any, spec: Any, name: str, physics: Physics) -> None:
    """A box whose top is the plane z = 0 of its body, which is moved as wanted; it waits far below."""
    body = spec.worldbody.add_body(name=name, pos=[0, 0, -_TABLE_AWAY])
    body.add_freejoint()
    half = 0.5 * _TABLE_THICKNESS
    set_contact(
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[_TABLE_HALF, _TABLE_HALF, half], pos=[0, 0, -half]),
        physics,
        4,
    )
    body.mass, body.inertia, body.explicitinertial = _TABLE_MASS, [_TABLE_MASS] * 3, True


def add_hull(mujoco: Any, spec: Any, body: Any, vertices: np.ndarray, name: str) -> None:
    """Give a body the convex hull of vertices (V, 3) [m] to collide with; a sliver is left out."""
    try:
        if ConvexHull(vertices).volume < LEAST_VOLUME:
            return
    except QhullError:
        return
    mesh = spec.add_mesh(name=name, uservert=np.asarray(vertices, float).ravel())
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name)

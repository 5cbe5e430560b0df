"""Scene and protocol -> a MuJoCo model, with the tables that map rows of a shard to its state."""

from collections.abc import Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from lgrasp.errors import PhysicsError, short_reason
from lgrasp.hand.couplings import resolve_mimic
from lgrasp.hand.links import joint_values, joints_above, mimics_of
from lgrasp.runtime.optional import import_mujoco
from lgrasp.simulate.assemble import OBJECT, TABLE, assemble
from lgrasp.simulate.protocol import Protocol
from lgrasp.simulate.scene import Scene

_NEAR_DISTANCE = 1.0e-3  # [m]
_TABLE_TOLERANCE = 1.0e-12  # of the solver, with a table


class TableBody(NamedTuple):
    """A heavy free body that is put where it is wanted before each step."""

    body: int
    """-1: there is none."""
    address: np.ndarray
    """(7,) places of its position and quaternion in qpos."""
    velocity: np.ndarray
    """(6,) places of its velocity in qvel."""


@dataclass(frozen=True, eq=False)
class Model:
    """A hand and O objects of a scene, compiled, itself only; K columns of q, J joints of the hand in MuJoCo."""

    mujoco: Any
    """MjModel"""
    mujoco_near: Any
    """MjModel in which hand and objects touch within 1 mm."""
    protocol: Protocol
    forces: np.ndarray
    """(O,) pull on each object [N]."""
    joint_address: np.ndarray
    """(J,) place of each joint in qpos."""
    joint_matrix: np.ndarray
    """(J, K): joint positions = joint_matrix @ q + joint_offset, mimic joints included."""
    joint_offset: np.ndarray
    """(J,) [rad or m]"""
    columns: np.ndarray
    """Columns of q in the order of the controls."""
    held: dict[str, tuple[int, float]]
    """Joints of q that are welded: column and the value at which they are welded [rad or m]."""
    object_address: np.ndarray
    """(O, 7) places of each object's position and quaternion in qpos."""
    object_velocity: np.ndarray
    """(O, 6) places of each object's linear and angular velocity in qvel."""
    object_body: np.ndarray
    """(O,)"""
    base_body: int
    link_body: np.ndarray
    """(L,) body of each of the shard's links, -1: none."""
    table: TableBody
    """Of protocols that lift off a table."""
    tables: tuple[np.ndarray | None, ...]
    """Planes that each object rests on (T, 5), in the frame of its centre of mass."""

    def controls(self, q: np.ndarray) -> np.ndarray:
        """Targets of the drives at joint positions q (..., K)."""
        return np.where(self.columns >= 0, q[..., self.columns], 0.0)

    def steps(self, seconds: float) -> int:
        """How many steps some time takes, at least one."""
        return max(1, round(seconds / self.mujoco.opt.timestep))

    def own(self) -> "Model":
        """The same with a copy of ``mujoco``, whose numbers may be changed."""
        return replace(self, mujoco=copy(self.mujoco))


def build_model(scene: Scene, protocol: Protocol, q: np.ndarray, objects: Sequence[int] = (0,)) -> Model:
    """Compile a hand with some objects of its scene; the last few are kept.

    Args:
        q: one row of joint positions (K,) [rad or m]; joints above the base link, and what mimics them, are welded.
        objects: positions in ``scene.objects``; one may be there twice.

    Raises:
        PhysicsError: MuJoCo is missing or refuses the hand; its reason is in the message.
    """
    import_mujoco()
    hand = scene.hand.record
    column = {name: k for k, name in enumerate(hand.joint_names)}
    joints = scene.hand.joints
    still = {joint.name for joint in joints_above(joints, hand.base_link)}
    while more := {joint.name for joint in joints if joint.mimic and joint.mimic[0] in still} - still:
        still |= more
    values = joint_values(mimics_of(joints), {name: q[k : k + 1].astype(float) for name, k in column.items()})
    held = tuple((name, float(value[0])) for name, value in values.items() if name in still)
    return _build(scene, protocol.model_dump_json(), held, tuple(objects))


@lru_cache(maxsize=8)
def _build(scene: Scene, text: str, held: tuple[tuple[str, float], ...], objects: tuple[int, ...]) -> Model:
    mujoco, hand, protocol = import_mujoco(), scene.hand.record, Protocol.model_validate_json(text)
    solids = [scene.objects[index] for index in objects]
    try:
        spec = assemble(mujoco, scene.hand, solids, protocol, dict(held))
        model = spec.compile()
        for geom in spec.geoms:
            if geom.parent.name.startswith(OBJECT):
                geom.margin = _NEAR_DISTANCE
        near = spec.compile()
        if protocol.table:
            for made in (model, near):  # it is relative to all bodies, and the table is heavy
                made.opt.tolerance = _TABLE_TOLERANCE
    except (ValueError, KeyError, RuntimeError) as error:
        names = ", ".join(f"'{solid.name}'" for solid in solids)
        raise PhysicsError(
            f"MuJoCo refuses hand '{hand.name}' with object {names}: {short_reason(error, 300)}"
        ) from None
    column = {name: k for k, name in enumerate(hand.joint_names)}
    joints = np.flatnonzero(model.jnt_type != mujoco.mjtJoint.mjJNT_FREE)
    matrix, offset = np.zeros((len(joints), len(column))), np.zeros(len(joints))
    for row, (at, factor, shift) in enumerate(leaders(model, joints)):
        offset[row] = shift
        if model.joint(at).name in column:
            matrix[row, column[model.joint(at).name]] = factor
    driven = [model.actuator(i).name for i in range(model.nu)]
    bodies = np.array([model.body(f"{OBJECT} {number}").id for number in range(len(solids))])
    free = model.body_jntadr[bodies]
    base = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, hand.base_link)
    return Model(
        mujoco=model,
        mujoco_near=near,
        protocol=protocol,
        forces=np.array([protocol.load(solid.volume).force for solid in solids]),
        joint_address=model.jnt_qposadr[joints].copy(),
        joint_matrix=matrix,
        joint_offset=offset,
        columns=np.array([column.get(name, -1) for name in driven]),
        held={name: (column[name], value) for name, value in held if name in column},
        object_address=model.jnt_qposadr[free][:, None] + np.arange(7),
        object_velocity=model.jnt_dofadr[free][:, None] + np.arange(6),
        object_body=bodies,
        base_body=base,
        link_body=np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in hand.link_names]),
        table=_table_of(model) if protocol.table else TableBody(-1, np.zeros(0, int), np.zeros(0, int)),
        tables=tuple(solid.planes() for solid in solids),
    )


def leaders(model: Any, joints: Iterable[int]) -> list[tuple[int, float, float]]:
    """For each joint of an MjModel the one that it follows, itself if none: position = factor x that one's + offset.

    Returns:
        Joint, factor and offset [rad or m].
    """
    equal = model.eq_type == import_mujoco().mjtEq.mjEQ_JOINT
    follows = zip(model.eq_obj1id[equal], model.eq_obj2id[equal], model.eq_data[equal, :2].tolist(), strict=True)
    mimics = {int(a): (int(b), multiplier, shift) for a, b, (shift, multiplier) in follows}
    return [resolve_mimic(int(joint), mimics) for joint in joints]


def effort_limit(model: Any, joint: int) -> float:
    """What the drive of a joint of an MjModel can press with at most [N m or N]; infinite: no limit."""
    return float(model.jnt_actfrcrange[joint, 1]) if model.jnt_actfrclimited[joint] else np.inf


def drive_gains(model: Any, drive: int) -> tuple[float, float]:
    """Stiffness [N m/rad or N/m] and damping of a drive of an MjModel."""
    return float(model.actuator_gainprm[drive, 0]), float(-model.actuator_biasprm[drive, 2])


def mesh_corners(model: Any, geom: int) -> np.ndarray:
    """Vertices of a geom of an MjModel that is a mesh (V, 3) [m]."""
    mesh = int(model.geom_dataid[geom])
    first = int(model.mesh_vertadr[mesh])
    return model.mesh_vert[first : first + int(model.mesh_vertnum[mesh])]


def pairs_apart(model: Any) -> list[tuple[int, int]]:
    """Bodies that an MjModel has never collide: neighbours, and those that always touch."""
    return [divmod(int(signature), 1 << 16) for signature in model.exclude_signature]


def _table_of(model: Any) -> TableBody:
    body = model.body(TABLE)
    joint = int(body.jntadr[0])
    place, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
    return TableBody(int(body.id), place + np.arange(7), dof + np.arange(6))

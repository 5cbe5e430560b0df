"""Scene and protocol -> a MuJoCo model, with the tables that map rows of a shard to its state."""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from lgrasp.errors import PhysicsError
from lgrasp.physics.assemble import OBJECT, assemble
from lgrasp.physics.protocol import Load, Protocol
from lgrasp.physics.scene import Scene
from lgrasp.physics.urdf import welded_joints

__all__ = ["Model", "build_model", "import_mujoco"]

_NEAR = 1.0e-3  # [m]


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

    def controls(self, q: np.ndarray) -> np.ndarray:
        """Targets of the drives at joint positions q (K,)."""
        return np.where(self.columns >= 0, q[self.columns], 0.0)


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
    """Compile a scene; the last few are kept.

    Args:
        q: one row of joint positions (K,) [rad or m]; joints above the base link are welded there.

    Raises:
        PhysicsError: MuJoCo is missing or refuses the hand; its reason is in the message.
    """
    import_mujoco()
    joints = scene.hand.joint_names
    carried = [name for name in welded_joints(scene.hand.urdf, scene.hand.base_link) if name in joints]
    return _build(scene, protocol.model_dump_json(), tuple((name, float(q[joints.index(name)])) for name in carried))


@lru_cache(maxsize=4)
def _build(scene: Scene, text: str, held: tuple[tuple[str, float], ...]) -> Model:
    mujoco = import_mujoco()
    protocol = Protocol.model_validate_json(text)
    load = protocol.load(scene.object.volume)
    try:
        spec = assemble(mujoco, scene, protocol, load, dict(held))
        model = spec.compile()
        for geom in spec.body(OBJECT).geoms:
            geom.margin = _NEAR
        near = spec.compile()
    except (ValueError, KeyError, RuntimeError) as error:
        reason = " ".join(str(error).split())[:300]
        raise PhysicsError(
            f"MuJoCo refuses hand '{scene.hand.name}' with object '{scene.object.name}': {reason}"
        ) from None
    return _tables(mujoco, model, near, scene, protocol, load, held)


def _tables(
    mujoco: Any,
    model: Any,
    near: Any,
    scene: Scene,
    protocol: Protocol,
    load: Load,
    held: tuple[tuple[str, float], ...],
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
        held={name: (column[name], value) for name, value in held},
        object_address=int(model.jnt_qposadr[model.body_jntadr[body]]),
        object_body=body,
        base_body=base,
        link_body=np.array([mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, n) for n in hand.link_names]),
        hand_bodies=np.arange(model.nbody) != body,
        center=scene.object.center,
    )

"""The same hand and objects in PhysX (package sapien): hard contacts, no torsional friction."""

import warnings
from collections.abc import Callable
from functools import wraps
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.errors import PhysicsError
from lgrasp.runtime.optional import import_mujoco, import_optional
from lgrasp.simulate.model import Model, drive_gains, effort_limit, leaders, mesh_corners, pairs_apart
from lgrasp.simulate.verdict import WILD
from lgrasp.simulate.world import World

CONTACT_OFFSET = 0.002
"""Shapes closer than this have contact points, which press when they are closer than 0 [m]."""
ITERATIONS = [25, 1]
"""Of the solver (TGS), on positions and velocities."""
DEPENETRATION = 1.0
"""Largest speed with which bodies that overlap come apart [m/s]."""
PERSISTENT = False
"""Whether contacts are found by PhysX's persistent manifolds (PCM), not afresh in each step by separating axes. PCM now
and then finds convex pieces that are 0.3 mm apart 4 mm deep in each other, which throws the object out of the hand."""
SOLVER = {
    "contact_offset": CONTACT_OFFSET,
    "persistent_contacts": PERSISTENT,
    "iterations": ITERATIONS,
    "depenetration": DEPENETRATION,
    "not_used": ["torsion", "impratio", "noslip", "softness"],
}
"""What decides a verdict besides the protocol, and the numbers of the protocol that mean nothing here."""

_COUPLING = 5.0  # stiffness with which joints of one drive are held together, over that of the drive
_AHEAD = 0.8  # of the motion in one step, that coupled joints are expected to go on with
_NO_LIMIT = 3.0e38  # of a drive
_ROTATE_X_TO_Z = [np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]  # w x y z: PhysX's capsules lie along x, MuJoCo's along z


def import_physx() -> Any:
    """The modules sapien and sapien.physx.

    Raises:
        PhysicsError: it is not installed.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of graphics that are not used
        return import_optional("--engine physx needs the package sapien", '"lgrasp[physx]"', "sapien", "physx")


class _Coupled(NamedTuple):
    """J joints of one drive, at multiplier x (position of the drive) + offset."""

    drive: int
    joints: np.ndarray
    """(J,) places in the articulation."""
    multiplier: np.ndarray
    """(J,)"""
    offset: np.ndarray
    """(J,) [rad or m]"""
    tie: np.ndarray
    """(2, J) stiffness and damping with which each is held to all of them."""
    own: np.ndarray
    """(2, J) likewise with which each takes its part in the drive."""
    limit: float
    """Effort limit of the drive [N m or N]."""


def _recorded(act: Callable[..., None]) -> Callable[..., None]:
    """An act that :meth:`PhysxWorld.restore` can repeat."""

    @wraps(act)
    def recorded(self: "PhysxWorld", *args: Any) -> None:
        self._past.append((recorded, args))
        act(self, *args)

    return recorded


class PhysxWorld(World):
    """A PhysX scene made of what MuJoCo compiled: its bodies, inertias, shapes, joints and drives, number by number.

    Contacts are hard; friction acts at the points of a contact patch without torsional term, and joints that one drive
    moves share it and are held to their mean.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._sapien = import_physx()
        self._px = self._sapien.physx
        self._mujoco = import_mujoco()
        self._m = model.mujoco
        self._ignored = self._ignore_groups()
        self._past: list[tuple[Callable[..., None], tuple[Any, ...]]] = []

    @_recorded
    def begin(self, q: np.ndarray, poses: np.ndarray) -> None:
        del self._past[:-1]
        self._make()
        model = self._model
        positions = np.zeros(len(self._joints), np.float32)
        positions[self._column] = model.joint_matrix @ q + model.joint_offset
        self._hand.set_qpos(positions)
        self._hand.set_qvel(np.zeros_like(positions))
        self._aim(model.controls(q))
        base = self._links[model.base_body].entity.pose
        for component, pose in zip(self._objects, poses.astype(float), strict=True):
            component.entity.pose = base * self._sapien.Pose(pose[:3], pose[3:] / np.linalg.norm(pose[3:]))
            component.set_linear_velocity(np.zeros(3))
            component.set_angular_velocity(np.zeros(3))

    @_recorded
    def drive(self, targets: np.ndarray) -> None:
        self._aim(targets)

    def _aim(self, targets: np.ndarray) -> None:
        self._targets = targets
        shared = {coupled.drive for coupled in self._coupled}
        for drive, (joint, target) in enumerate(zip(self._driven, targets, strict=True)):
            if drive not in shared:
                joint.set_drive_target(float(target))

    @_recorded
    def press(self, loads: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
        self._loads = loads

    @_recorded
    def place_table(self, pose: np.ndarray) -> None:
        self._table.entity.pose = self._sapien.Pose(pose[:3], pose[3:])
        self._table_pose = np.array(pose, float)

    @_recorded
    def slide_table(self, by: np.ndarray) -> None:
        self._table_pose[:3] += by
        self._table.set_kinematic_target(self._sapien.Pose(self._table_pose[:3], self._table_pose[3:]))

    @_recorded
    def step(self, steps: int) -> None:
        for _ in range(steps):
            if self._ran_away:
                return  # contacts of what is nowhere would end the process
            for body, load in self._loads.items():
                self._component[body].add_force_torque(*load)
            if self._coupled:
                self._tie()
            self._system.step()
            self._ran_away = not np.isfinite(self._speeds()).all()

    def _tie(self) -> None:
        """Aim the joints of each drive at where the drive wants them and, far more stiffly, at where they are on the
        whole: such forces cancel in the drive, so that nothing but its own torque moves it."""
        q = np.asarray(self._hand.get_qpos(), float)
        # from positions: the velocities that PhysX tells are not those under load
        speed = np.zeros_like(q) if self._before is None else (q - self._before) / self._m.opt.timestep
        self._before = q
        for c in self._coupled:
            (k, d), (k_own, d_own), f = c.tie, c.own, c.multiplier
            rate = _AHEAD * (f * d * speed[c.joints]).sum() / (f * f * d).sum()
            mean = (f * k * (q[c.joints] - c.offset)).sum() / (f * f * k).sum()
            ahead = mean + 0.5 * rate * self._m.opt.timestep
            targets = f * (k * ahead + k_own * self._within_effort(c, ahead, rate)) / (k + k_own) + c.offset
            for place, target, velocity in zip(c.joints, targets, f * rate * d / (d + d_own), strict=True):
                self._joints[place].set_drive_target(float(target))
                self._joints[place].set_drive_velocity_target(float(velocity))

    def _within_effort(self, c: _Coupled, at: float, rate: float) -> float:
        """The target of a drive, or the one at which it presses with its effort limit, at a position and speed."""
        target, (gain, damping) = float(self._targets[c.drive]), drive_gains(self._m, c.drive)
        effort = gain * (target - at) - damping * rate
        if abs(effort) <= c.limit:
            return target
        return at + (np.copysign(c.limit, effort) + damping * rate) / gain

    def state(self) -> Any:
        """All that was done since :meth:`begin`, which decides what comes next."""
        return tuple(self._past)

    def restore(self, state: Any) -> None:
        """Do it again: of the friction that it remembers from step to step PhysX gives no copy."""
        for act, args in state:
            act(self, *args)

    def objects(self) -> np.ndarray:
        poses = [component.entity.pose for component in self._objects]
        return np.array([[*pose.p, *pose.q] for pose in poses], float)

    def velocities(self) -> np.ndarray:
        found = [[*c.get_linear_velocity(), *c.get_angular_velocity()] for c in self._objects]
        return np.array(found, float)

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        at, turn = np.zeros((self._m.nbody, 3)), np.tile(np.eye(3), (self._m.nbody, 1, 1))
        for component, body in self._number.items():
            pose = component.entity.pose
            at[body], turn[body] = pose.p, Rotation.from_quat(pose.q, scalar_first=True).as_matrix()
        return at, turn

    def deepest(self) -> float:
        own = set(self._model.object_body.tolist())
        return max([0.0, *(-apart for pair, apart in self._contacts() if own & {*pair})])

    def wild(self) -> bool:
        return not np.abs(self._speeds()).max() < WILD

    def _speeds(self) -> np.ndarray:
        """Of the objects and the joints."""
        return np.concatenate([self.velocities().ravel(), self._hand.get_qvel()])

    def _contacts(self) -> list[tuple[list[int], float]]:
        """Both bodies of each contact, and how far they are apart [m]."""
        contacts = [contact for contact in self._system.get_contacts() if contact.points]
        return [([self._number[body] for body in c.bodies], min(p.separation for p in c.points)) for c in contacts]

    def touching(self) -> np.ndarray:
        return np.array([pair for pair, apart in self._contacts() if apart < 0.0], int).reshape(-1, 2)

    def _make(self) -> None:
        """A scene without a past: what PhysX remembers of contacts would let one grasp decide the next."""
        px, mujoco, model, m = self._px, self._mujoco, self._model, self._m
        px.set_scene_config(
            gravity=np.zeros(3),
            bounce_threshold=2.0,
            enable_pcm=PERSISTENT,
            enable_tgs=True,
            enable_friction_every_iteration=True,
            enable_enhanced_determinism=True,
        )
        px.set_shape_config(contact_offset=CONTACT_OFFSET, rest_offset=0.0)
        px.set_body_config(*ITERATIONS, 0.0)
        self._system = px.PhysxCpuSystem()
        self._system.timestep = m.opt.timestep
        self._scene = self._sapien.Scene([self._system])
        friction = float(m.geom_friction[:, 0].max())
        self._material = px.PhysxMaterial(friction, friction, 0.0)
        self._objects: list[Any] = []
        self._links: dict[int, Any] = {}
        self._build()
        self._component = self._links | dict(zip(model.object_body.tolist(), self._objects, strict=True))
        self._number = {component: body for body, component in self._component.items()}
        if model.table.body >= 0:
            self._number[self._table] = model.table.body
        self._hand = self._links[0].articulation
        self._joints = list(self._hand.get_active_joints())
        order = {joint.child_link: k for k, joint in enumerate(self._joints)}
        hand_joints = [j for j in range(m.njnt) if m.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
        self._column = np.array([order[self._links[int(m.jnt_bodyid[j])]] for j in hand_joints])
        row = {j: k for k, j in enumerate(hand_joints)}
        self._driven = [self._joints[self._column[row[int(m.actuator_trnid[a, 0])]]] for a in range(m.nu)]
        self._coupled: list[_Coupled] = []
        self._before: np.ndarray | None = None  # positions of the joints a step ago
        self._couple(row)
        self._loads: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._ran_away = False

    def _ignore_groups(self) -> np.ndarray:
        """A bit for each pair of bodies that must not collide (B,), but for neighbours, which PhysX leaves out."""
        m = self._m
        pairs = [(a, b) for a, b in pairs_apart(m) if m.body_parentid[a] != b and m.body_parentid[b] != a]
        if len(pairs) > 32:
            raise PhysicsError(f"PhysX: {len(pairs)} pairs of links that must not collide; at most 32 can be told")
        bits = np.zeros(m.nbody, np.int64)
        for number, (a, b) in enumerate(pairs):
            bits[a] |= 1 << number
            bits[b] |= 1 << number
        return bits

    def _build(self) -> None:
        sapien, px, m = self._sapien, self._px, self._m
        objects, table, entities = {int(body) for body in self._model.object_body}, self._model.table.body, []
        for body in range(m.nbody):
            entity = sapien.Entity()
            if body in objects:
                component = px.PhysxRigidDynamicComponent()
                self._objects.append(component)
            elif body == table:
                component = self._table = px.PhysxRigidDynamicComponent()
                component.kinematic = True
                entity.pose = sapien.Pose(m.body_pos[body])
            else:
                parent = self._links[int(m.body_parentid[body])] if body else None
                component = px.PhysxArticulationLinkComponent(parent)
                self._links[body] = component
                self._join(body, component)
            self._add_shapes(body, component)
            if body:
                component.set_mass(float(m.body_mass[body]))
                component.set_inertia(np.asarray(m.body_inertia[body], np.float32))
                component.set_cmass_local_pose(sapien.Pose(m.body_ipos[body], m.body_iquat[body]))
            component.set_linear_damping(0.0)
            component.set_angular_damping(0.0)
            component.set_max_depenetration_velocity(DEPENETRATION)
            entity.add_component(component)
            entities.append(entity)
        for entity in entities:
            self._scene.add_entity(entity)

    def _join(self, body: int, link: Any) -> None:
        """Give a link its joint: limits, armature, drive."""
        sapien, m, joint = self._sapien, self._m, link.joint
        link.name = joint.name = str(body)
        if body == 0:
            joint.type = "fixed"
            return
        frame = sapien.Pose(m.body_pos[body], m.body_quat[body])
        if m.body_jntnum[body] == 0:
            joint.type, joint.pose_in_parent = "fixed", frame
            return
        j = int(m.body_jntadr[body])
        slides = m.jnt_type[j] == self._mujoco.mjtJoint.mjJNT_SLIDE
        axis = Rotation.align_vectors(m.jnt_axis[j][None], [[1.0, 0, 0]])[0].as_quat(scalar_first=True)
        at = sapien.Pose(m.jnt_pos[j], axis)
        joint.type = "prismatic" if slides else "revolute"
        joint.pose_in_parent, joint.pose_in_child = frame * at, at
        limits = m.jnt_range[j] if m.jnt_limited[j] else [-np.inf, np.inf]
        joint.set_limits(np.asarray([limits], np.float32))
        joint.set_armature(np.asarray(m.dof_armature[m.jnt_dofadr[j]], np.float32).reshape(1))
        joint.set_friction(0.0)
        driven = np.flatnonzero(m.actuator_trnid[:, 0] == j)
        if len(driven):
            joint.set_drive_property(*drive_gains(m, int(driven[0])), min(effort_limit(m, j), _NO_LIMIT))

    def _add_shapes(self, body: int, component: Any) -> None:
        sapien, px, m = self._sapien, self._px, self._m
        for geom in np.flatnonzero(m.geom_bodyid == body):
            pose = sapien.Pose(m.geom_pos[geom], m.geom_quat[geom])
            kind, size = m.geom_type[geom], m.geom_size[geom]
            if kind == self._mujoco.mjtGeom.mjGEOM_MESH:
                corners = np.asarray(mesh_corners(m, geom), np.float32)
                shape = px.PhysxCollisionShapeConvexMesh(corners, np.ones(3, np.float32), self._material)
            elif kind == self._mujoco.mjtGeom.mjGEOM_SPHERE:
                shape = px.PhysxCollisionShapeSphere(float(size[0]), self._material)
            elif kind == self._mujoco.mjtGeom.mjGEOM_BOX:
                shape = px.PhysxCollisionShapeBox(np.asarray(size, np.float32), self._material)
            else:
                shape = px.PhysxCollisionShapeCapsule(float(size[0]), float(size[1]), self._material)
                pose = pose * sapien.Pose(q=_ROTATE_X_TO_Z)
            shape.local_pose = pose
            shape.set_collision_groups([1, 1, int(self._ignored[body]), 0])
            component.attach(shape)

    def _couple(self, row: dict[int, int]) -> None:
        """Share each drive of several joints out among them; :meth:`_tie` holds them together.

        Tendons of PhysX pass on too little of a torque, and what drives a joint after another one must not press on it.
        """
        m, driven = self._m, {int(j): a for a, j in enumerate(self._m.actuator_trnid[:, 0])}
        members: dict[int, list[tuple[int, float, float]]] = {}
        for joint, (at, factor, offset) in zip(row, leaders(m, row), strict=True):
            members.setdefault(at, []).append((joint, factor, offset))
        arm = np.where(m.jnt_type == self._mujoco.mjtJoint.mjJNT_SLIDE, self._model.protocol.lever, 1.0)
        for leader, some in members.items():
            if len(some) == 1 or leader not in driven:
                continue
            joints, multiplier, offset = (np.array(column) for column in zip(*some, strict=True))
            gain, damping = drive_gains(m, driven[leader])
            stiffness = _COUPLING * gain * (arm[leader] / arm[joints]) ** 2
            tie = np.stack([stiffness, 2.0 * np.sqrt(stiffness * m.dof_M0[m.jnt_dofadr[joints]])])
            own = np.array([[gain], [damping]]) * tie / (multiplier**2 * tie).sum(1, keepdims=True)
            places = np.array([self._column[row[int(joint)]] for joint in joints])
            for place, (k, d) in zip(places, (tie + own).T, strict=True):
                self._joints[place].set_drive_property(float(k), float(d))
            self._coupled.append(
                _Coupled(driven[leader], places, multiplier, offset, tie, own, effort_limit(m, leader))
            )

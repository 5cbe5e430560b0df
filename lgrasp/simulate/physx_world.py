"""The same hand and objects in PhysX (package sapien): hard contacts, no torsional friction."""

import warnings
from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.errors import PhysicsError
from lgrasp.simulate.builder import import_mujoco
from lgrasp.simulate.model import Model
from lgrasp.simulate.verdict import WILD, links_touching

CONTACT_OFFSET = 0.002
"""Shapes closer than this have contact points, which press when they are closer than 0 [m]."""
ITERATIONS = (25, 1)
"""Of the solver (TGS), on positions and velocities."""
SOLVER = {
    "contact_offset": CONTACT_OFFSET,
    "iterations": ITERATIONS,
    "not_used": ("torsion", "impratio", "noslip", "softness"),
}
"""What decides a verdict besides the protocol, and the numbers of the protocol that mean nothing here."""

_TENDON = 1.0e5  # stiffness of a tendon that couples joints
_COUPLING = 5.0  # stiffness of a mimic joint's drive over that of its source
_AWAY = 10.0  # [m] where objects wait while the contacts of the grasp before are forgotten
_ROTATE_X_TO_Z = [np.sqrt(0.5), 0.0, -np.sqrt(0.5), 0.0]  # w x y z: PhysX's capsules lie along x, MuJoCo's along z


def import_physx() -> Any:
    """The modules sapien and sapien.physx.

    Raises:
        PhysicsError: it is not installed.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of graphics that are not used
            import sapien
            import sapien.physx
    except ImportError:
        raise PhysicsError(
            '--engine physx needs the package sapien, which is not installed: pip install "lgrasp[physx]"'
        ) from None
    return sapien


class _Follower(NamedTuple):
    """A mimic joint: multiplier x source + offset."""

    joint: int
    source: int
    multiplier: float
    offset: float
    stiffness: float


class PhysxWorld:
    """A PhysX scene made of what MuJoCo compiled: its bodies, inertias, shapes, joints and drives, number by number.

    The interface is that of :class:`lgrasp.simulate.mujoco_world.MujocoWorld`. Contacts are hard; friction
    acts at the points of a contact patch without torsional term, and a mimic joint is held to its source by a stiff
    tendon if it is the next one, else driven after its source, which bears its torque.

    Args:
        model: O objects in the order of the rows.
    """

    def __init__(self, model: Model) -> None:
        self._sapien = import_physx()
        self._px = self._sapien.physx
        self._mujoco = import_mujoco()
        self._model, self._m = model, model.mujoco
        self._ignored = self._ignore_groups()

    def begin(self, q: np.ndarray, poses: np.ndarray) -> None:
        """Hand at q (K,), objects at poses (O, 7) in the base frame, everything at rest."""
        self._make()
        model = self._model
        positions = np.zeros(len(self._joints), np.float32)
        positions[self._column] = model.joint_matrix @ q + model.joint_offset
        self._hand.set_qpos(positions)
        self._hand.set_qvel(np.zeros_like(positions))
        self.drive(model.controls(q))
        base = self.links[model.base_body].entity.pose
        for component, pose in zip(self._objects, poses.astype(float), strict=True):
            component.entity.pose = base * self._sapien.Pose(pose[:3], pose[3:] / np.linalg.norm(pose[3:]))
            component.set_linear_velocity(np.zeros(3))
            component.set_angular_velocity(np.zeros(3))

    def _forget(self) -> None:
        """Move the objects away, so that nothing is left of their contacts, which PhysX remembers from step to step."""
        for k, component in enumerate(self._objects):
            component.entity.pose = self._sapien.Pose([_AWAY * (k + 1), 0, 0])
            component.set_linear_velocity(np.zeros(3))
            component.set_angular_velocity(np.zeros(3))
        self._system.step()

    def drive(self, targets: np.ndarray) -> None:
        """Set the targets of the drives (nu,) [rad or m]."""
        self._targets = targets
        for joint, target in zip(self._driven, targets, strict=True):
            joint.set_drive_target(float(target))

    def push(self, forces: np.ndarray) -> None:
        """Pull on the objects' centres of mass from now on (O, 3) [N], world frame."""
        self._forces[:] = forces

    def place_table(self, pose: np.ndarray) -> None:
        """Put the table, whose top is z = 0 of its frame, at a pose (7,) in the world."""
        self._table.entity.pose = self._sapien.Pose(pose[:3], pose[3:])
        self._table_pose = np.array(pose, float)

    def slide_table(self, by: np.ndarray) -> None:
        """In the next step the table moves by a vector (3,) [m] and nothing else, whatever presses on it."""
        self._table_pose[:3] += by
        self._table.set_kinematic_target(self._sapien.Pose(self._table_pose[:3], self._table_pose[3:]))

    def step(self, steps: int) -> None:
        """Go on for some steps of the protocol."""
        for _ in range(steps):
            for component, force in zip(self._objects, self._forces, strict=True):
                component.add_force_torque(force, np.zeros(3))
            if self._followers:
                self._follow()
            self._system.step()

    def _follow(self) -> None:
        """Mimic joints go where their sources are, which bear their torques."""
        q, speed = self._hand.get_qpos(), self._hand.get_qvel()
        borne = np.zeros_like(q)
        for f in self._followers:
            target, velocity = f.multiplier * q[f.source] + f.offset, f.multiplier * speed[f.source]
            self._joints[f.joint].set_drive_target(float(target))
            self._joints[f.joint].set_drive_velocity_target(float(velocity))
            borne[f.source] -= f.multiplier * f.stiffness * (target - q[f.joint])
        self._hand.set_qf(borne)

    def state(self) -> Any:
        """Everything that decides what comes next, as far as PhysX gives it: not the contacts that it remembers."""
        return self._system.pack(), self._targets, self._forces.copy()

    def restore(self, state: Any) -> None:
        """Inverse of :meth:`state`."""
        packed, targets, forces = state
        self._forget()
        self._system.unpack(packed)
        self.drive(targets)
        self._forces[:] = forces

    def objects(self) -> np.ndarray:
        """Poses of the objects (O, 7)."""
        poses = [component.entity.pose for component in self._objects]
        return np.array([[*pose.p, *pose.q] for pose in poses], float)

    def velocities(self) -> np.ndarray:
        """Linear [m/s] and angular [rad/s] velocities of the objects (O, 6)."""
        found = [[*c.get_linear_velocity(), *c.get_angular_velocity()] for c in self._objects]
        return np.array(found, float)

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Positions (B, 3) [m] and rotations (B, 3, 3) of the bodies in the world."""
        at, turn = np.zeros((self._m.nbody, 3)), np.tile(np.eye(3), (self._m.nbody, 1, 1))
        for component, body in self._number.items():
            pose = component.entity.pose
            at[body], turn[body] = pose.p, Rotation.from_quat(pose.q, scalar_first=True).as_matrix()
        return at, turn

    def links_touching(self) -> np.ndarray:
        """Number of the hand's bodies in contact with each object (O,)."""
        bodies = [pair for pair, points in self._contacts() if min(p.separation for p in points) < 0.0]
        bodies = np.array(bodies, int).reshape(-1, 2)
        return links_touching(bodies, self._model.object_body, self._m.nbody)

    def on_table(self) -> bool:
        """Whether an object touches the table."""
        pairs = {frozenset(pair) for pair, points in self._contacts() if min(p.separation for p in points) < 0.0}
        return any({self._model.table.body, int(body)} in pairs for body in self._model.object_body)

    def deepest(self) -> float:
        """Deepest penetration of any object, in a link or in another object [m]."""
        own = set(self._model.object_body.tolist())
        found = [p.separation for pair, points in self._contacts() if own & {*pair} for p in points]
        return max(0.0, -min(found, default=0.0))

    def wild(self) -> bool:
        """True if the simulation has diverged."""
        speed = np.concatenate([self.velocities().ravel(), self._hand.get_qvel()])
        return not np.abs(speed).max() < WILD

    def _contacts(self) -> list[tuple[tuple[int, int], Any]]:
        found = []
        for contact in self._system.get_contacts():
            if contact.points:
                a, b = contact.bodies
                found.append(((self._number[a], self._number[b]), contact.points))
        return found

    def _make(self) -> None:
        """A scene without a past: what PhysX remembers of contacts would let one grasp decide the next."""
        px, mujoco, model, m = self._px, self._mujoco, self._model, self._m
        px.set_scene_config(
            gravity=np.zeros(3),
            bounce_threshold=2.0,
            enable_pcm=True,
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
        self.links: dict[int, Any] = {}
        self._build()
        self._number = {component: body for body, component in self.links.items()}
        self._number |= {c: int(b) for b, c in zip(model.object_body, self._objects, strict=True)}
        if model.table.body >= 0:
            self._number[self._table] = model.table.body
        self._hand = self.links[0].articulation
        self._joints = list(self._hand.get_active_joints())
        order = {joint.child_link: k for k, joint in enumerate(self._joints)}
        hand_joints = [j for j in range(m.njnt) if m.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE]
        self._column = np.array([order[self.links[int(m.jnt_bodyid[j])]] for j in hand_joints])
        row = {j: k for k, j in enumerate(hand_joints)}
        self._driven = [self._joints[self._column[row[int(m.actuator_trnid[a, 0])]]] for a in range(m.nu)]
        self._followers: list[_Follower] = []
        self._couple(row)
        self._forces = np.zeros((len(self._objects), 3), np.float32)

    def _ignore_groups(self) -> np.ndarray:
        """A bit for each pair of bodies that must not collide (B,), but for neighbours, which PhysX leaves out."""
        m = self._m
        pairs = [divmod(int(signature), 1 << 16) for signature in m.exclude_signature]
        pairs = [(a, b) for a, b in pairs if m.body_parentid[a] != b and m.body_parentid[b] != a]
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
                parent = self.links[int(m.body_parentid[body])] if body else None
                component = px.PhysxArticulationLinkComponent(parent)
                self.links[body] = component
                self._join(body, component)
            self._add_shapes(body, component)
            if body:
                component.set_mass(float(m.body_mass[body]))
                component.set_inertia(np.asarray(m.body_inertia[body], np.float32))
                component.set_cmass_local_pose(sapien.Pose(m.body_ipos[body], m.body_iquat[body]))
            component.set_linear_damping(0.0)
            component.set_angular_damping(0.0)
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
        stiffness, damping = (
            (m.actuator_gainprm[driven[0], 0], -m.actuator_biasprm[driven[0], 2]) if len(driven) else (0, 0)
        )
        joint.set_drive_property(float(stiffness), float(damping))

    def _add_shapes(self, body: int, component: Any) -> None:
        sapien, px, m = self._sapien, self._px, self._m
        for geom in np.flatnonzero(m.geom_bodyid == body):
            pose = sapien.Pose(m.geom_pos[geom], m.geom_quat[geom])
            kind, size = m.geom_type[geom], m.geom_size[geom]
            if kind == self._mujoco.mjtGeom.mjGEOM_MESH:
                mesh = int(m.geom_dataid[geom])
                first = int(m.mesh_vertadr[mesh])
                vertices = m.mesh_vert[first : first + int(m.mesh_vertnum[mesh])]
                shape = px.PhysxCollisionShapeConvexMesh(
                    np.asarray(vertices, np.float32), np.ones(3, np.float32), self._material
                )
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
        """Hold mimic joints to their sources: by tendons where one link follows the other, else by :meth:`_follow`."""
        m = self._m
        for e in np.flatnonzero(m.eq_type == self._mujoco.mjtEq.mjEQ_JOINT):
            follower, source = (int(self._column[row[int(j)]]) for j in (m.eq_obj1id[e], m.eq_obj2id[e]))
            offset, multiplier = (float(x) for x in m.eq_data[e, :2])
            joint, leader = self._joints[follower], self._joints[source]
            if joint.parent_link == leader.child_link and multiplier:
                self._hand.create_fixed_tendon(
                    [leader.parent_link, leader.child_link, joint.child_link],
                    [0, -multiplier, 1],
                    [0, -multiplier, 1],  # forces, by virtual work
                    rest_length=offset,
                    stiffness=_TENDON,
                )
                continue
            stiffness = float(_COUPLING * m.actuator_gainprm[:, 0].max())
            damping = 2.0 * np.sqrt(stiffness * m.dof_M0[m.jnt_dofadr[m.eq_obj1id[e]]])
            joint.set_drive_property(stiffness, float(damping))
            self._followers.append(_Follower(follower, source, multiplier, offset, stiffness))

"""The same hand and objects in Drake: hydroelastic contact, whose patches have pressure and area; a convex solver."""

from typing import Any

import numpy as np

from lgrasp.errors import PhysicsError, short_reason
from lgrasp.runtime.optional import import_mujoco, import_optional
from lgrasp.simulate.model import Model, drive_gains, effort_limit, leaders, mesh_corners, pairs_apart
from lgrasp.simulate.verdict import WILD
from lgrasp.simulate.world import World

MODULUS = 1.0e7
"""Hydroelastic modulus of every body [Pa]."""
DISSIPATION = 20.0
"""Of contacts, by Hunt and Crossley [s/m]."""
APPROXIMATION = "lagged"
"""Of contacts in discrete time."""
SOLVER = {
    "contact": "hydroelastic",
    "modulus": MODULUS,
    "dissipation": DISSIPATION,
    "approximation": APPROXIMATION,
    "not_used": ["torsion", "impratio", "noslip", "softness"],
}
"""What decides a verdict besides the protocol, and the numbers of the protocol that mean nothing here."""

_RESOLUTION = 0.005  # of round shapes [m]


def import_drake() -> Any:
    """The package pydrake with the modules that are used.

    Raises:
        PhysicsError: it is not installed.
    """
    modules = ("common.eigen_geometry", "geometry", "math", "multibody.math", "multibody.plant", "multibody.tree")
    systems = ("systems.analysis", "systems.framework")
    return import_optional("--engine drake needs Drake", '"lgrasp[drake]"', "pydrake", *modules, *systems)


class DrakeWorld(World):
    """A Drake plant made of what MuJoCo compiled: its bodies, inertias, shapes, joints and drives, number by number.

    Friction has no torsional term: contact patches resist twists by their area. Joints that one drive moves are
    coupled by a constraint.

    Raises:
        PhysicsError: Drake is missing or refuses a body; its reason is in the message.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self._drake, self._mujoco = import_drake(), import_mujoco()
        self._m = model.mujoco
        if not model.protocol.draws:
            self._make()

    def begin(self, q: np.ndarray, poses: np.ndarray) -> None:
        if self._model.protocol.draws:  # the model's numbers are others each time
            self._make()
        model, tree = self._model, self._drake.multibody.tree
        self._time, self._gave_up = 0, False
        self._root.SetTime(0.0)
        self._plant.SetVelocities(self._context, np.zeros(self._plant.num_velocities()))
        for joint, value in zip(self._joints.values(), model.joint_matrix @ q + model.joint_offset, strict=True):
            put = joint.set_translation if isinstance(joint, tree.PrismaticJoint) else joint.set_angle
            put(self._context, float(value))
        base = self._plant.EvalBodyPoseInWorld(self._context, self._bodies[model.base_body])
        for body, pose in zip(self._objects, poses, strict=True):
            self._plant.SetFreeBodyPose(self._context, body, base @ self._transform(pose[:3], pose[3:]))
        self.drive(model.controls(q))
        self.push(np.zeros((len(self._objects), 3)))
        self._simulator.Initialize()

    def drive(self, targets: np.ndarray) -> None:
        self._targets = targets
        positions = np.where(self._actuators >= 0, targets[self._actuators], 0.0)
        self._wanted.FixValue(self._context, np.concatenate([positions, np.zeros_like(positions)]))

    def press(self, loads: dict[int, tuple[np.ndarray, np.ndarray]]) -> None:
        self._loads, pulls = loads, []
        for number, (force, torque) in loads.items():
            pull = self._drake.multibody.plant.ExternallyAppliedSpatialForce()
            pull.body_index, pull.p_BoBq_B = self._bodies[number].index(), self._m.body_ipos[number]
            pull.F_Bq_W = self._drake.multibody.math.SpatialForce(tau=torque, f=np.asarray(force, float))
            pulls.append(pull)
        self._pulls.FixValue(self._context, pulls)

    def place_table(self, pose: np.ndarray) -> None:
        self._table_pose = np.array(pose, float)
        self._put_table(np.zeros(3))

    def slide_table(self, by: np.ndarray) -> None:
        self._put_table(by / self._m.opt.timestep)
        self._table_pose[:3] += by

    def _put_table(self, velocity: np.ndarray) -> None:
        table, at = self._bodies[self._model.table.body], self._transform(self._table_pose[:3], self._table_pose[3:])
        motion = self._drake.multibody.math.SpatialVelocity(w=np.zeros(3), v=velocity)
        self._plant.SetFreeBodyPose(self._context, table, at)
        self._plant.SetFreeBodySpatialVelocity(context=self._context, body=table, V_JpJc=motion)

    def step(self, steps: int) -> None:
        self._time += steps
        try:
            self._simulator.AdvanceTo(self._time * self._m.opt.timestep)
        except RuntimeError:  # the contact solver found no solution
            self._gave_up = True

    def state(self) -> Any:
        return self._time, self._gave_up, self._root.Clone(), self._targets, self._loads

    def restore(self, state: Any) -> None:
        self._time, self._gave_up, before, targets, loads = state
        self._root.SetTimeStateAndParametersFrom(before)
        self.drive(targets)
        self.press(loads)
        self._simulator.Initialize()

    def objects(self) -> np.ndarray:
        poses = [self._plant.EvalBodyPoseInWorld(self._context, body) for body in self._objects]
        return np.array([[*pose.translation(), *pose.rotation().ToQuaternion().wxyz()] for pose in poses])

    def velocities(self) -> np.ndarray:
        found = [self._plant.EvalBodySpatialVelocityInWorld(self._context, body) for body in self._objects]
        return np.array([[*motion.translational(), *motion.rotational()] for motion in found])

    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        poses = [self._plant.EvalBodyPoseInWorld(self._context, body) for body in self._bodies]
        return np.array([p.translation() for p in poses]), np.array([p.rotation().matrix() for p in poses])

    def deepest(self) -> float:
        own = set(self._model.object_body.tolist())
        query = self._plant.get_geometry_query_input_port().Eval(self._context)
        pairs = query.ComputePointPairPenetration()
        return max([0.0, *(pair.depth for pair in pairs if own & {self._number[pair.id_A], self._number[pair.id_B]})])

    def wild(self) -> bool:
        return self._gave_up or not np.abs(self._plant.GetVelocities(self._context)).max() < WILD

    def touching(self) -> np.ndarray:
        found = self._plant.get_contact_results_output_port().Eval(self._context)
        surfaces = [
            found.hydroelastic_contact_info(k).contact_surface() for k in range(found.num_hydroelastic_contacts())
        ]
        points = [found.point_pair_contact_info(k).point_pair() for k in range(found.num_point_pair_contacts())]
        pairs = [(surface.id_M(), surface.id_N()) for surface in surfaces] + [(p.id_A, p.id_B) for p in points]
        return np.array([[self._number[a], self._number[b]] for a, b in pairs], int).reshape(-1, 2)

    def _make(self) -> None:
        """The plant with the numbers that the model has now."""
        try:
            self._build()
        except RuntimeError as error:
            raise PhysicsError(f"Drake refuses the hand or an object: {short_reason(error, 300)}") from None

    def _build(self) -> None:
        drake, model, m = self._drake, self._model, self._m
        builder = drake.systems.framework.DiagramBuilder()
        config = drake.multibody.plant.MultibodyPlantConfig(
            time_step=m.opt.timestep, discrete_contact_approximation=APPROXIMATION
        )
        self._plant, scene_graph = drake.multibody.plant.AddMultibodyPlant(config, builder)
        self._plant.mutable_gravity_field().set_gravity_vector(np.zeros(3))
        self._hand = self._plant.AddModelInstance("hand")
        self._number: dict[Any, int] = {}
        self._bodies: list[Any] = []
        for body in range(m.nbody):
            self._bodies.append(self._add_body(body))
        self._joints: dict[int, Any] = {}
        for body in range(1, m.nbody):
            if not self._free(body):
                self._join(body)
        self._drive()
        self._plant.Finalize()
        self._leave_out(scene_graph)
        self._simulator = drake.systems.analysis.Simulator(builder.Build())
        self._root = self._simulator.get_mutable_context()
        self._context = self._plant.GetMyMutableContextFromRoot(self._root)
        self._wanted = self._plant.get_desired_state_input_port(self._hand)
        self._pulls = self._plant.get_applied_spatial_force_input_port()
        self._objects = [self._bodies[int(body)] for body in model.object_body]

    def _free(self, body: int) -> bool:
        return body == self._model.table.body or body in self._model.object_body

    def _transform(self, at: np.ndarray, turn: np.ndarray) -> Any:
        """A pose from a position (3,) and a quaternion w x y z (4,)."""
        turn = np.asarray(turn, float)
        quaternion = self._drake.common.eigen_geometry.Quaternion(turn / np.linalg.norm(turn))
        return self._drake.math.RigidTransform(quaternion, np.asarray(at, float))

    def _add_body(self, number: int) -> Any:
        """A body with its inertia and shapes; the world is the first."""
        tree, m = self._drake.multibody.tree, self._m
        body = self._plant.world_body()
        if number:
            principal = tree.RotationalInertia(*m.body_inertia[number])
            turn = self._transform(np.zeros(3), m.body_iquat[number]).rotation()
            inertia = tree.SpatialInertia.MakeFromCentralInertia(
                float(m.body_mass[number]), m.body_ipos[number], principal.ReExpress(turn)
            )
            owner = self._plant.AddModelInstance(f"free {number}") if self._free(number) else self._hand
            body = self._plant.AddRigidBody(str(number), owner, inertia)
        for geom in np.flatnonzero(m.geom_bodyid == number):
            pose = self._transform(m.geom_pos[geom], m.geom_quat[geom])
            shape = self._plant.RegisterCollisionGeometry(body, pose, self._shape(geom), str(geom), self._surface())
            self._number[shape] = number
        return body

    def _shape(self, geom: int) -> Any:
        shapes, kinds, m = self._drake.geometry, self._mujoco.mjtGeom, self._m
        kind, size = m.geom_type[geom], m.geom_size[geom]
        if kind == kinds.mjGEOM_MESH:
            return shapes.Convex(points=mesh_corners(m, geom).T.astype(float), label=str(geom))
        if kind == kinds.mjGEOM_SPHERE:
            return shapes.Sphere(float(size[0]))
        if kind == kinds.mjGEOM_BOX:
            return shapes.Box(*(2.0 * size))
        return shapes.Capsule(float(size[0]), 2.0 * float(size[1]))

    def _surface(self) -> Any:
        """How all shapes touch."""
        drake, friction = self._drake, float(self._m.geom_friction[:, 0].max())
        found = drake.geometry.ProximityProperties()
        drake.geometry.AddContactMaterial(
            dissipation=DISSIPATION,
            friction=drake.multibody.plant.CoulombFriction(friction, friction),
            properties=found,
        )
        drake.geometry.AddCompliantHydroelasticProperties(_RESOLUTION, MODULUS, found)
        return found

    def _join(self, body: int) -> None:
        """Give a link its joint, with its limits."""
        tree, m = self._drake.multibody.tree, self._m
        parent, own = (self._bodies[k].body_frame() for k in (int(m.body_parentid[body]), body))
        pose = self._transform(m.body_pos[body], m.body_quat[body])
        if m.body_jntnum[body] == 0:
            self._plant.AddJoint(tree.WeldJoint(f"weld {body}", parent, own, pose))
            return
        j = int(m.body_jntadr[body])
        at = self._drake.math.RigidTransform(m.jnt_pos[j].astype(float))
        kind = tree.PrismaticJoint if m.jnt_type[j] == self._mujoco.mjtJoint.mjJNT_SLIDE else tree.RevoluteJoint
        low, high = m.jnt_range[j] if m.jnt_limited[j] else (-np.inf, np.inf)
        self._joints[j] = self._plant.AddJoint(
            kind(
                str(j),
                self._plant.AddFrame(tree.FixedOffsetFrame(f"parent {j}", parent, pose @ at)),
                self._plant.AddFrame(tree.FixedOffsetFrame(f"child {j}", own, at)),
                m.jnt_axis[j].astype(float),
                float(low),
                float(high),
            )
        )

    def _drive(self) -> None:
        """Inertia and effort limit of every joint's drive, control of those driven, couplings of the others."""
        m, driven = self._m, {int(j): a for a, j in enumerate(self._m.actuator_trnid[:, 0])}
        self._actuators = np.array([driven.get(j, -1) for j in self._joints])
        for (j, joint), (leader, factor, offset) in zip(self._joints.items(), leaders(m, self._joints), strict=True):
            actuator = self._plant.AddJointActuator(f"drive {j}", joint, effort_limit(m, j))
            actuator.set_default_rotor_inertia(float(m.dof_armature[m.jnt_dofadr[j]]))
            if j in driven:
                gain, damping = drive_gains(m, driven[j])
                actuator.set_controller_gains(self._drake.multibody.tree.PdControllerGains(p=gain, d=damping))
            if leader != j:
                self._plant.AddCouplerConstraint(joint, self._joints[leader], factor, offset)

    def _leave_out(self, scene_graph: Any) -> None:
        """Pairs of bodies that must not collide."""
        shapes = self._drake.geometry
        of_body: dict[int, list[Any]] = {}
        for shape, body in self._number.items():
            of_body.setdefault(body, []).append(shape)
        for a, b in pairs_apart(self._m):
            if a in of_body and b in of_body:
                rule = shapes.CollisionFilterDeclaration().ExcludeBetween(
                    shapes.GeometrySet(of_body[a]), shapes.GeometrySet(of_body[b])
                )
                scene_graph.collision_filter_manager().Apply(rule)

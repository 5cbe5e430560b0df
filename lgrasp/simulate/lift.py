"""Protocol ``lift``: the hand comes to an object on a table, closes, takes it up and shakes it.

All is told from the hand, whose base stands still as in every protocol: the table moves by the opposite of the hand's
way, and the object feels its weight and the inertia of the hand's acceleration. Nothing pulls at the hand's own links:
the controller carries them.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.errors import PhysicsError
from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.model import Model
from lgrasp.simulate.protocol import Protocol
from lgrasp.simulate.scene import Scene
from lgrasp.simulate.solid import Solid
from lgrasp.simulate.verdict import CHUNK, Bounds, Look, Verdict, at_rest, moved

if TYPE_CHECKING:
    from lgrasp.simulate.mujoco_world import MujocoWorld
    from lgrasp.simulate.physx_world import PhysxWorld


class LiftCourse(NamedTuple):
    """What the hand does in T steps."""

    way: np.ndarray
    """Where its base is before each step and at the end, seen from the grasp, base frame (T + 1, 3) [m]."""
    targets: np.ndarray
    """Of the drives in each step (T, nu) [rad or m]."""
    closes: int
    """Step in which it begins to close."""
    rises: int
    """Step in which it begins to rise."""


class Lifted(NamedTuple):
    """What came of it."""

    pushed: float = np.nan
    moved: np.ndarray = np.full(2, np.nan)
    settled: bool = False
    on_table: bool = False
    diverged: bool = False
    steps: int = 0


def check_on_table(scene: Scene, rows: GraspRows) -> None:
    """Raises PhysicsError unless each row names a plane that its one object rests on, and a way to it."""
    index = np.asarray(rows.object_index)
    if not {"pose", "approach"} <= set(rows.table) or any(solid.tables is None for solid in scene.objects):
        said = "they do not say how the object lies on a table"
    elif index.shape[1] != 1:
        said = "they have several objects"
    elif not all(_known(rows.table["pose"][index[:, 0] == k], solid) for k, solid in enumerate(scene.objects)):
        said = "table/pose names a plane that the object does not have"
    else:
        return
    raise PhysicsError(f"protocol lift cannot simulate these grasps: {said}; lgrasp generate --table makes such")


def _known(pose: np.ndarray, solid: Solid) -> bool:
    return bool((pose < len(solid.tables if solid.tables is not None else ())).all())


def course_of(protocol: Protocol, stops: Sequence[np.ndarray], up: np.ndarray, approach: np.ndarray) -> LiftCourse:
    """The hand's course.

    Args:
        protocol: with a ``lift``.
        stops: targets of the drives (nu,) [rad or m]: open, grasp, squeeze.
        up, approach: unit vectors, base frame (3,).
    """
    lift, dt = protocol.lift, protocol.timestep
    assert lift

    def steps(seconds: float) -> int:
        return max(1, round(seconds / dt))

    coming, closing, rest, rising = map(steps, (lift.coming, protocol.phase, protocol.rest + dt, lift.rising))
    come = -lift.way * (1.0 - _smooth(coming))[:, None] * approach
    closed = np.zeros(((len(stops) - 1) * closing + rest, 3))
    rise = lift.height * _smooth(rising)[:, None] * up
    push = _shaking(protocol, up)
    shaken = rise[-1] + np.cumsum(np.cumsum(push, axis=0), axis=0) * dt**2
    even = np.arange(1, closing + 1)[:, None] / closing
    close = [a + (b - a) * even for a, b in pairwise(stops)]
    return LiftCourse(
        way=np.concatenate([come, closed, rise[1:], shaken]),
        targets=np.concatenate(
            [np.tile(stops[0], (coming, 1)), *close, np.tile(stops[-1], (rest + rising + len(push), 1))]
        ),
        closes=coming,
        rises=coming + len(closed),
    )


def _smooth(steps: int) -> np.ndarray:
    """Share of a way from rest to rest with a smooth acceleration, (steps + 1,)."""
    t = np.linspace(0.0, 1.0, steps + 1)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def _shaking(protocol: Protocol, up: np.ndarray) -> np.ndarray:
    """Acceleration of the hand in each step of the hold, base frame (n, 3) [m/s^2]."""
    lift, count = protocol.lift, max(1, round(protocol.hold / protocol.timestep))
    assert lift
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    sideways = np.stack([first, np.cross(up, first)])
    second = np.arange(count) >= count // 2
    time = (np.arange(count) - second * (count // 2)) * protocol.timestep
    return lift.shake * np.sin(2.0 * np.pi * lift.frequency * time)[:, None] * sideways[second.astype(int)]


def lift_row(world: "MujocoWorld | PhysxWorld", model: Model, rows: GraspRows, i: int) -> Lifted:
    """Simulate row ``i``, whose object has the planes of ``model``."""
    protocol, pose = model.protocol, rows.object_pose[i].astype(float)
    table, up = _table_at(model, pose[0], int(rows.table["pose"][i]))
    stops = [targets[i].astype(float) for targets in protocol.stops(rows)]
    approach = rows.table["approach"][i].astype(float)
    course = course_of(protocol, [model.controls(q) for q in stops], up, approach / np.linalg.norm(approach))
    away = np.concatenate([-course.way[0], np.zeros(4)])
    world.begin(stops[0], pose)
    home = world.objects().copy()
    world.begin(stops[0], pose + away)
    at, turn = (found[model.base_body].copy() for found in world.frames())
    world.place_table(_placed(at, turn, table + away))
    return _carry(world, model, course, home, course.way @ turn.T, turn @ up)


def _carry(
    world: "MujocoWorld | PhysxWorld",
    model: Model,
    course: LiftCourse,
    home: np.ndarray,
    way: np.ndarray,
    up: np.ndarray,
) -> Lifted:
    """Go through a course from where everything stands.

    Args:
        home: poses of the objects at the grasp, world frame (O, 7).
        way: of ``course``, world frame (T + 1, 3) [m].
        up: world frame (3,).
    """
    dt, bounds = model.protocol.timestep, Bounds(model.protocol)
    mass = model.mujoco.body_mass[model.object_body][:, None]
    weight = -model.forces[:, None] * up
    speed, pushed, settled = np.zeros(3), np.nan, False
    far = np.zeros((len(home), 2))
    chunk, total = max(1, round(CHUNK / dt)), len(course.targets)
    for step in range(total):
        if step == course.closes:
            pushed = float(moved(world.objects(), home, model.centers)[:, 0].max())
        if step == course.rises:
            home, settled = world.objects().copy(), bool(at_rest(world.velocities()))
        before, speed = speed, (way[step + 1] - way[step]) / dt
        world.drive(course.targets[step])
        world.push(weight - mass * (speed - before) / dt)
        world.slide_table(-dt * speed)
        world.step(1)
        if (step + 1) % chunk == 0 or step + 1 == total:
            if world.wild():
                return Lifted(pushed, settled=settled, diverged=True, steps=step + 1)
            if step >= course.rises:
                far = np.maximum(far, moved(world.objects(), home, model.centers))
                if bounds.lost(far):
                    return Lifted(pushed, far.max(0), settled, world.on_table(), steps=step + 1)
    return Lifted(pushed, far.max(0), settled, world.on_table(), steps=total)


def _table_at(model: Model, pose: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the table (7,) below an object at ``pose`` (7,), and the unit vector up (3,), base frame."""
    planes = model.tables[0]
    assert planes is not None
    turn = Rotation.from_quat(pose[3:], scalar_first=True)
    normal, height = planes[number, :3].astype(float), float(planes[number, 3])
    up = turn.apply(normal / np.linalg.norm(normal))
    below = turn.apply(model.centers[0]) + pose[:3]
    at = below + (height + up @ pose[:3] - up @ below) * up
    facing = Rotation.align_vectors(up[None], [[0.0, 0.0, 1.0]])[0]
    return np.concatenate([at, facing.as_quat(scalar_first=True)]), up


def _placed(at: np.ndarray, turn: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """A pose (7,) of the base frame, which is at ``at`` (3,) and turned by ``turn`` (3, 3), in the world."""
    facing = Rotation.from_matrix(turn) * Rotation.from_quat(pose[3:], scalar_first=True)
    return np.concatenate([at + turn @ pose[:3], facing.as_quat(scalar_first=True)])


def conclude_lift(bounds: Bounds, look: Look, found: Lifted) -> Verdict:
    """The verdict of one grasp."""
    stays = bool(bounds.stays(found.moved[None]))
    return Verdict(
        holds=stays and not found.on_table,
        directions=np.full(6, -1, np.int8),
        displacement=found.moved[0],
        rotation=found.moved[1],
        slip=np.nan,
        contact_at_q=int(look.contact_at_q.min()),
        contact_at_grasp=-1,
        pregrasp_penetration=look.depth,
        settled=found.settled,
        diverged=found.diverged,
        stays=stays,
        penetration=look.object_depth,
        object_touches=np.full(1, -1, np.int8),
        object_displacement=found.moved[:1],
        object_rotation=found.moved[1:],
        pushed=found.pushed,
        on_table=found.on_table,
    )

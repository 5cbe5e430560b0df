"""Protocols that move the hand: it comes to an object on a table or is at a free one, closes, takes it up and holds it;
or it is shaken and turned with objects in it.

All is told from the hand, whose base stands still as in every protocol: the table moves by the opposite of the hand's
way, and objects feel their weight and the inertia of the hand's acceleration; turns are slow, their inertia is left
out. Nothing pulls at the hand's own links: the controller carries them.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.errors import PhysicsError
from lgrasp.grasp.records import GraspRows
from lgrasp.simulate.model import Model
from lgrasp.simulate.protocol import GRAVITY, FreeLift, Lift, Protocol, Shake
from lgrasp.simulate.verdict import AXES, Bounds, Look, Verdict, at_rest, chunk_of, moved
from lgrasp.simulate.world import World

_ORDER = (0, 2, 4, 1, 3, 5)  # of AXES: each at a right angle to the one before
_WAVES = 4  # of each axis


class LiftCourse(NamedTuple):
    """What the hand does in T steps."""

    way: np.ndarray
    """Where its base is before each step and at the end, seen from the grasp, base frame (T + 1, 3) [m]."""
    targets: np.ndarray
    """Of the drives in each step (T, nu) [rad or m]."""
    down: np.ndarray
    """Gravity over its strength in each step, base frame (T, 3)."""
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


def check_liftable(protocol: Protocol, tables: Sequence[np.ndarray | None], rows: GraspRows) -> None:
    """Raises PhysicsError unless each row has one object and, to lift it off a table, names a plane that this rests
    on, of ``tables`` of all objects, and a way to it."""
    index, said = np.asarray(rows.object_index), ""
    if index.shape[1] != 1:
        said = "they have several objects"
    elif protocol.table:
        planes = [planes for planes in tables if planes is not None]
        hint = "lgrasp generate --table makes such"
        if not {"pose", "approach"} <= set(rows.table) or len(planes) < len(tables):
            said = f"they do not say how the object lies on a table; {hint}"
        elif any((rows.table["pose"][index[:, 0] == k] >= len(known)).any() for k, known in enumerate(planes)):
            said = f"table/pose names a plane that the object does not have; {hint}"
    if said:
        raise PhysicsError(f"protocol {protocol.name} cannot simulate these grasps: {said}")


def course_of(
    protocol: Protocol,
    stops: Sequence[np.ndarray],
    up: np.ndarray,
    approach: np.ndarray | None = None,
    candidate: int = 0,
) -> LiftCourse:
    """The hand's course.

    Args:
        protocol: with a ``lift``.
        stops: targets of the drives (nu,) [rad or m]: open, grasp, squeeze.
        up, approach: unit vectors, base frame (3,); no approach: the hand is at the grasp from the start.
        candidate: of the row.
    """
    lift, dt = protocol.lift, protocol.timestep
    assert lift

    def steps(seconds: float) -> int:
        return max(1, round(seconds / dt))

    closing, rest, rising = map(steps, (protocol.phase, protocol.rest + dt, lift.rising))
    come, push = np.zeros((1, 3)), np.zeros((steps(protocol.hold), 3))
    if isinstance(lift, Lift):
        assert approach is not None
        come, push = -lift.way * (1.0 - smooth(steps(lift.coming)))[:, None] * approach, _swaying(lift, push, dt, up)
    closes = len(come) - 1
    closed = np.zeros(((len(stops) - 1) * closing + rest, 3))
    rise = lift.height * smooth(rising)[:, None] * up
    held = rise[-1] + push.cumsum(axis=0).cumsum(axis=0) * dt**2
    even = np.arange(1, closing + 1)[:, None] / closing
    close = [a + (b - a) * even for a, b in pairwise(stops)]
    rises = closes + len(closed)
    down = np.tile(-up, (rises + rising + len(push), 1))
    if isinstance(lift, FreeLift):
        down[:rises] = 0.0
        turned = _turns(lift, steps(lift.turning), candidate)
        first = len(down) - (len(push) + len(turned)) // 2
        down[first : first + len(turned)] = turned
    return LiftCourse(
        way=np.concatenate([come, closed, rise[1:], held]),
        targets=np.concatenate(
            [np.tile(stops[0], (closes, 1)), *close, np.tile(stops[-1], (rest + rising + len(push), 1))]
        ),
        down=down,
        closes=closes,
        rises=rises,
    )


def smooth(steps: int) -> np.ndarray:
    """Share of a way from rest to rest with a smooth acceleration, (steps + 1,)."""
    t = np.linspace(0.0, 1.0, steps + 1)
    return t**3 * (10.0 - 15.0 * t + 6.0 * t**2)


def _swaying(lift: Lift, still: np.ndarray, dt: float, up: np.ndarray) -> np.ndarray:
    """Acceleration of the hand in each step of the hold, base frame [m/s^2], shaped as ``still`` (n, 3)."""
    count = len(still)
    first = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    first /= np.linalg.norm(first)
    sideways = np.stack([first, np.cross(up, first)])
    second = np.arange(count) >= count // 2
    time = (np.arange(count) - second * (count // 2)) * dt
    return lift.shake * np.sin(2.0 * np.pi * lift.frequency * time)[:, None] * sideways[second.astype(int)]


def _turns(lift: FreeLift, steps: int, candidate: int) -> np.ndarray:
    """Directions of gravity in each step in which it is turned, even on the sphere, (steps, 3); none: (0, 3)."""
    ways = np.random.default_rng([lift.seed, candidate]).standard_normal((lift.turns, 3))
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    return ways[np.arange(steps) * lift.turns // steps] if lift.turns else ways


def lift_row(world: World, model: Model, rows: GraspRows, i: int) -> Lifted:
    """Simulate row ``i``, whose object has the planes of ``model``."""
    protocol, pose = model.protocol, rows.object_pose[i].astype(float)
    stops = [targets[i].astype(float) for targets in protocol.stops(rows)]
    controls, candidate = [model.controls(q) for q in stops], int(rows.candidate[i])
    world.begin(stops[0], pose)
    home = world.objects().copy()
    at, turn = (found[model.base_body].copy() for found in world.frames())
    if protocol.table:
        table, up = _table_at(model, pose[0], int(rows.table["pose"][i]))
        approach = rows.table["approach"][i].astype(float)
        course = course_of(protocol, controls, up, approach / np.linalg.norm(approach), candidate)
        away = np.concatenate([-course.way[0], np.zeros(4)])
        world.begin(stops[0], pose + away)
        world.place_table(_placed(at, turn, table + away))
    else:
        up = Rotation.from_quat(pose[0, 3:], scalar_first=True).as_matrix()[:, 2]
        course = course_of(protocol, controls, up, candidate=candidate)
    return _carry(world, model, course._replace(way=course.way @ turn.T, down=course.down @ turn.T), home)


def _carry(world: World, model: Model, course: LiftCourse, home: np.ndarray) -> Lifted:
    """Go through a course from where everything stands; ``home``: objects at the grasp (O, 7), world frame."""
    dt, bounds, table = model.protocol.timestep, Bounds(model.protocol), model.protocol.table
    mass, weight = model.mujoco.body_mass[model.object_body][:, None], model.forces[:, None]
    speed, pushed, settled = np.zeros(3), np.nan, False
    far, counts = np.zeros((len(home), 2)), course.rises if table else 0
    chunk, total = max(1, round(chunk_of(model.protocol) / dt)), len(course.targets)
    for step in range(total):
        if step == course.closes:
            pushed = float(moved(world.objects(), home)[:, 0].max())
        if step == course.rises:
            home = world.objects().copy() if table else home
            settled = bool(at_rest(world.velocities()))
        before, speed = speed, (course.way[step + 1] - course.way[step]) / dt
        world.drive(course.targets[step])
        world.push(weight * course.down[step] - mass * (speed - before) / dt)
        if table:
            world.slide_table(-dt * speed)
        world.step(1)
        if (step + 1) % chunk == 0 or step + 1 == total:
            if world.wild():
                return Lifted(pushed, settled=settled, diverged=True)
            if step >= counts:
                far = np.maximum(far, moved(world.objects(), home))
                if bounds.lost(far):
                    break
    return Lifted(pushed, far.max(0), settled, world.on_table())


def _table_at(model: Model, pose: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Pose of the table (7,) below an object at ``pose`` (7,), and the unit vector up (3,), base frame."""
    planes = model.tables[0]
    assert planes is not None
    turn = Rotation.from_quat(pose[3:], scalar_first=True)
    normal, height = planes[number, :3].astype(float), float(planes[number, 3])
    up = turn.apply(normal / np.linalg.norm(normal))
    facing = Rotation.align_vectors(up[None], [[0.0, 0.0, 1.0]])[0]
    return np.concatenate([pose[:3] + height * up, facing.as_quat(scalar_first=True)]), up


def _placed(at: np.ndarray, turn: np.ndarray, pose: np.ndarray) -> np.ndarray:
    """A pose (7,) of the base frame, which is at ``at`` (3,) and turned by ``turn`` (3, 3), in the world."""
    facing = Rotation.from_matrix(turn) * Rotation.from_quat(pose[3:], scalar_first=True)
    return np.concatenate([at + turn @ pose[:3], facing.as_quat(scalar_first=True)])


def conclude_lift(bounds: Bounds, look: Look, found: Lifted) -> Verdict:
    """The verdict of one grasp."""
    return Verdict(
        holds=bool(bounds.stays(found.moved[None])) and not found.on_table,
        displacement=found.moved[0],
        rotation=found.moved[1],
        contact_at_q=int(look.contact_at_q.min()),
        pregrasp_penetration=look.depth,
        settled=found.settled,
        diverged=found.diverged,
        pushed=found.pushed,
        on_table=found.on_table,
    )


def shake_course(protocol: Protocol) -> dict[int, np.ndarray]:
    """What pulls at the objects in each step, over their weight, base frame.

    Returns:
        For each direction of gravity, by its place in AXES and in the order in which the hand goes through them, the
        way to it and the hold there, (T, 3). On the way to the first the hand is shaken.
    """
    shake, dt = protocol.shake, protocol.timestep
    assert shake
    hold = np.ones((max(1, round(protocol.hold / dt)), 1))
    angle = 0.5 * np.pi * smooth(max(1, round(shake.turning / dt)))[1:, None]
    course: dict[int, np.ndarray] = {}
    for before, k in zip((None, *_ORDER), _ORDER, strict=False):
        if before is None:
            way = AXES[k] - _shaking(shake, dt) / GRAVITY
        else:
            way = np.cos(angle) * AXES[before] + np.sin(angle) * AXES[k]
        course[k] = np.concatenate([way, hold * AXES[k]])
    return course


def _shaking(shake: Shake, dt: float) -> np.ndarray:
    """Acceleration of the hand in each step (n, 3) [m/s^2]: along each axis a sum of sines."""
    rng, time = np.random.default_rng(shake.seed), dt * np.arange(1, 1 + max(1, round(shake.shaking / dt)))
    frequency, phase = rng.uniform(*shake.frequency, (_WAVES, 3)), rng.uniform(0.0, 2 * np.pi, (_WAVES, 3))
    push = np.sin(2 * np.pi * frequency * time[:, None, None] + phase).sum(1)
    return shake.acceleration * push / np.linalg.norm(push, axis=1).max()

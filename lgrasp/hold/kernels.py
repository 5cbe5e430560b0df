"""Trials of grasps: the hand closes on the free object, then the object is pulled in six directions."""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hold.contacts import find_contacts, follow_contacts
from lgrasp.hold.energy import Body, Material, make_columns
from lgrasp.hold.scratch import MAX_HAND_DOFS, Contact, Scratch, Scratches, scratch_of
from lgrasp.hold.solve import solve_step
from lgrasp.math.constants import SLIDING_ARM
from lgrasp.math.kinematics import group_forward, vec_dof
from lgrasp.math.lanes import LANES, lanes_least, lanes_max, meet
from lgrasp.object.arrays import Object
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

BLOCKS = (LANES, 16)  # threads of a block, and blocks at a time: few registers each, as trials wait for memory
_REACH = wp.constant(2.0e-3)  # [m] contacts are looked for within
DRAWN_NUMBERS = wp.constant(12)
"""That a trial has, of the ranges of :class:`Spread` in turn, three each of ``shift`` and ``turn``."""
vec_numbers = wp.types.vector(12, wp.float32)
_TRAVEL = wp.constant(1.0e-3)  # [m] of hand and object after which they are looked for afresh


@wp.struct
class Course:
    """What all trials go through."""

    closing_steps: wp.int32  # from pregrasp to grasp, and again from there to squeeze
    closing_time: wp.float32  # of a step [s]
    pull_steps: wp.int32  # in each direction
    pull_time: wp.float32  # of a step [s]
    force: wp.float32  # the pull [N]
    most_displacement: wp.float32  # of the centre of mass [m]
    most_rotation: wp.float32  # [rad]
    drive_inertia: wp.float32  # of a joint and what it moves, by which its damping is measured [kg m^2]
    com: wp.vec3  # centre of mass of the object, internal frame [m]
    inertia: wp.mat33  # about it, over the mass, internal frame [m^2]


@wp.struct
class Spread:
    """Ranges that numbers are drawn from, evenly; ``shift`` and ``turn`` bound the error of the object's pose."""

    seed: wp.int32
    strata: wp.array2d(dtype=wp.float32)  # (D, 12) where in its range, from 0 to 1, each number of each draw is

    friction: wp.vec2
    torsion: wp.vec2  # [m]
    mass: wp.vec2  # [kg]
    stiffness: wp.vec2  # of revolute joints [N m/rad]
    damping_ratio: wp.vec2
    contact_stiffness: wp.vec2  # [N/m], its logarithm is even
    shift: wp.float32  # [m]
    turn: wp.float32  # [rad]


@wp.struct
class TriedGrasps:
    """Rows to try."""

    pregrasp: wp.array2d(dtype=wp.float32)  # (N, K) [rad or m]
    grasp: wp.array2d(dtype=wp.float32)  # (N, K) [rad or m]
    squeeze: wp.array2d(dtype=wp.float32)  # (N, K) [rad or m]
    pose: wp.array(dtype=wp.transform)  # (N,) T_hand_object, internal frame
    number: wp.array(dtype=wp.int32)  # (N,) from which a row's random numbers come


@wp.struct
class Motion:
    """A trial at one moment."""

    pose: wp.transform  # T_hand_object
    velocity: wp.spatial_vector  # of the object [m/s], [rad/s]
    displacement: wp.float32  # at worst until now [m]
    rotation: wp.float32  # at worst until now [rad]
    contacts: wp.int32  # how many there are
    lost: wp.int32  # 1: the object is out of its bounds


@wp.struct
class Trials:
    """Trials, and where they stand once the hand has closed."""

    row: wp.array(dtype=wp.int32)  # (T,)
    draw: wp.array(dtype=wp.int32)  # (T,) which of its grasp's draws it is
    start: wp.array(dtype=wp.transform)  # (T,) T_hand_object
    material: wp.array(dtype=Material)  # (T,) its ``drag`` is the damping [N m s/rad]
    mass: wp.array(dtype=wp.float32)  # (T,) [kg]
    motion: wp.array(dtype=Motion)  # (T,)
    contacts: wp.array2d(dtype=Contact)  # (T, MAX_TOUCHES)
    q: wp.array2d(dtype=wp.float32)  # (T, MAX_HAND_DOFS) [rad or m]


@wp.struct
class TrialPulls:
    """What came of each direction of each trial."""

    held: wp.array2d(dtype=wp.int32)  # (T, 6) 1 held, 0 not held or not tried
    displacement: wp.array2d(dtype=wp.float32)  # (T, 6) at worst, closing included [m]; 0 not tried


@wp.struct
class Workers:
    """Lanes that take one trial after another; W workers."""

    queue: wp.array(dtype=wp.int32)  # (1,) how many trials were taken
    scratch: Scratches  # W of it


@wp.func
def _between(ends: wp.vec2, share: wp.float32):
    return ends[0] + (ends[1] - ends[0]) * share


@wp.func
def _in_ball(radius: wp.float32, z: wp.float32, around: wp.float32, out: wp.float32):
    """A point of the ball, evenly if the shares are even."""
    up = 2.0 * z - 1.0
    flat = wp.sqrt(wp.max(1.0 - up * up, 0.0))
    angle = 2.0 * wp.pi * around
    return wp.vec3(flat * wp.cos(angle), flat * wp.sin(angle), up) * radius * wp.cbrt(out)


@wp.func
def _turned(T: wp.transform, com: wp.vec3, dx: wp.spatial_vector):
    """A pose after the motion dx of its centre of mass, which is at com in the object's frame."""
    w = wp.spatial_bottom(dx)
    angle = wp.length(w)
    r = wp.transform_get_rotation(T)
    c = wp.transform_point(T, com) + wp.spatial_top(dx)
    if angle > 1.0e-9:
        r = wp.normalize(wp.quat_from_axis_angle(w / angle, angle) * r)
    return wp.transform(c - wp.quat_rotate(r, com), r)


@wp.func
def _note(course: Course, s: Motion, start: wp.transform):
    """The motion with its worst displacement and rotation and whether it is lost; displacement and rotation now."""
    shift = wp.length(wp.transform_point(s.pose, course.com) - wp.transform_point(start, course.com))
    a = wp.transform_get_rotation(s.pose)
    b = wp.transform_get_rotation(start)
    turn = 2.0 * wp.acos(wp.min(wp.abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]), 1.0))
    s.displacement = wp.max(s.displacement, shift)
    s.rotation = wp.max(s.rotation, turn)
    if not (s.displacement <= course.most_displacement and s.rotation <= course.most_rotation):
        s.lost = 1
    return s, shift, turn


@wp.func
def _body(course: Course, s: Motion, mass: wp.float32, h: wp.float32, pull: wp.int32):
    """The object in a step of h [s]; pull -1: none, else the direction +x, -x, +y, ..."""
    body = Body()
    body.com = wp.transform_point(s.pose, course.com)
    body.mass = mass / (h * h)
    R = wp.quat_to_matrix(wp.transform_get_rotation(s.pose))
    body.inertia = R * course.inertia * wp.transpose(R) * body.mass
    body.free = s.velocity * h
    if pull >= 0:
        body.force[pull // 2] = course.force * (1.0 - 2.0 * float(pull % 2))
    return body


@wp.func
def _aim(hand: Hand, grasps: TriedGrasps, row: wp.int32, phase: wp.int32, share: wp.float32, w: Scratch):
    """Targets of the drives: phase 0 from pregrasp to grasp, 1 from grasp to squeeze, later the squeeze."""
    for k in range(w.lane, hand.kin.dof_first[hand.kin.groups], w.lanes):
        at = hand.kin.dof_index[k]
        b = grasps.grasp[row, at]
        if phase == 0:
            a = grasps.pregrasp[row, at]
            w.target[k] = a + share * (b - a)
        else:
            c = grasps.squeeze[row, at]
            w.target[k] = wp.where(phase == 1, b + share * (c - b), c)


@wp.func
def _place(hand: Hand, w: Scratch):
    """Write the pose of every moving body."""
    for g in range(w.lane, hand.kin.groups, w.lanes):
        v = vec_dof()
        first = hand.kin.dof_first[g]
        for d in range(hand.kin.dof_first[g + 1] - first):
            v[d] = w.q[first + d]
        group_forward(hand.kin, g, v, w.X, hand.kin.joint_first[g])


@wp.func
def _describe(hand: Hand, w: Scratch):
    """Write the group of each dof, its stiffness over that of a revolute joint and its effort limit; copies of a shared
    joint have these together."""
    dofs = hand.kin.dof_first[hand.kin.groups]
    for k in range(w.lane, dofs, w.lanes):
        g = int(0)
        while hand.kin.dof_first[g + 1] <= k:
            g += 1
        w.group[k] = g
        arm = wp.where(hand.kin.column_sliding[hand.kin.dof_index[k]] == 1, SLIDING_ARM, 1.0)
        copies = float(0.0)
        for o in range(dofs):
            if hand.kin.dof_index[o] == hand.kin.dof_index[k]:
                copies += 1.0
        w.scale[k] = 1.0 / (arm * arm * copies)
        w.effort[k] = hand.kin.column_effort[hand.kin.dof_index[k]] / copies


@wp.func
def _advance(hand: Hand, dx: wp.spatial_vector, w: Scratch):
    """Move the joints; returns how far points of hand and object have come [m], roughly."""
    far = wp.max(wp.length(wp.spatial_top(dx)), 0.5 * SLIDING_ARM * wp.length(wp.spatial_bottom(dx)))
    for k in range(w.lane, hand.kin.dof_first[hand.kin.groups], w.lanes):
        w.q[k] = w.q[k] + w.dq[k]
        far = wp.max(far, SLIDING_ARM * wp.abs(w.dq[k]) * wp.sqrt(w.scale[k]))
    return lanes_max(far)


@wp.func
def _go(
    hand: Hand,
    obj: Object,
    course: Course,
    grasps: TriedGrasps,
    trials: Trials,
    i: wp.int32,
    phase: wp.int32,
    s: Motion,
    w: Scratch,
):
    """Take trial i through a phase: 0 to the grasp, 1 to the squeeze, 2 ... 7 pulls; returns its motion at the end."""
    pull = phase - 2
    steps = wp.where(pull < 0, course.closing_steps, course.pull_steps)
    h = wp.where(pull < 0, course.closing_time, course.pull_time)
    m = trials.material[i]
    m.drag = m.drag / h
    travel = float(1.0e9)
    for step in range(steps):
        _aim(hand, grasps, trials.row[i], phase, float(step + 1) / float(steps), w)
        _place(hand, w)
        meet()
        if travel > _TRAVEL:
            s.contacts = find_contacts(hand, obj, w, s.pose, _REACH, s.contacts)
            travel = 0.0
        else:
            follow_contacts(hand, obj, w, s.pose, s.contacts)
        make_columns(hand, w, s.contacts)
        body = _body(course, s, trials.mass[i], h, pull)
        dx = solve_step(hand, m, body, s.contacts, w)
        travel += _advance(hand, dx, w)
        meet()
        s.velocity = dx / h
        s.pose = _turned(s.pose, course.com, dx)
        s, shift, turn = _note(course, s, trials.start[i])
        if s.lost == 1:
            break
        if pull >= 0 and step >= 2:
            # at four times this speed it stays well inside the bounds to the end
            ahead = 4.0 * float(steps - 1 - step)
            slide = shift + ahead * wp.length(wp.spatial_top(dx))
            roll = turn + ahead * wp.length(wp.spatial_bottom(dx))
            if slide < 0.5 * course.most_displacement and roll < 0.5 * course.most_rotation:
                break
    return s


@wp.func
def _next(queue: wp.array(dtype=wp.int32), w: Scratch):
    """Number of the next thing to do, the same in all lanes."""
    number = int(0x7FFFFFFF)
    if w.lane == 0:
        number = wp.atomic_add(queue, 0, 1)
    return lanes_least(number)


@wp.func
def _begin(course: Course, spread: Spread, grasps: TriedGrasps, trials: Trials, i: wp.int32, hand: Hand, w: Scratch):
    """Draw the numbers of trial i; returns it with the open hand about the object at rest."""
    row = trials.row[i]
    rng = wp.rand_init(spread.seed, grasps.number[row])
    u = vec_numbers()
    for k in range(DRAWN_NUMBERS):  # a function would get a copy of rng
        # the strata of a grasp's draws, all moved on by as much, round and round
        u[k] = spread.strata[trials.draw[i], k] + wp.randf(rng)
        u[k] = u[k] - wp.floor(u[k])
    m = Material()
    m.friction = _between(spread.friction, u[0])
    m.torsion = _between(spread.torsion, u[1])
    mass = _between(spread.mass, u[2])
    m.drive = _between(spread.stiffness, u[3])
    m.drag = _between(spread.damping_ratio, u[4]) * 2.0 * wp.sqrt(m.drive * course.drive_inertia)
    logarithms = wp.vec2(wp.log(spread.contact_stiffness[0]), wp.log(spread.contact_stiffness[1]))
    m.contact = wp.exp(_between(logarithms, u[5]))
    shift = _in_ball(spread.shift, u[6], u[7], u[8])
    error = _in_ball(spread.turn, u[9], u[10], u[11])
    s = Motion()
    s.pose = _turned(grasps.pose[row], course.com, wp.spatial_vector(shift, error))
    if w.lane == 0:
        trials.mass[i] = mass
        trials.material[i] = m
        trials.start[i] = s.pose
    for k in range(w.lane, hand.kin.dof_first[hand.kin.groups], w.lanes):
        w.q[k] = grasps.pregrasp[row, hand.kin.dof_index[k]]
    meet()
    return s


@wp.func
def _keep(trials: Trials, i: wp.int32, s: Motion, w: Scratch):
    """Write how trial i stands."""
    if w.lane == 0:
        trials.motion[i] = s
    for c in range(w.lane, s.contacts, w.lanes):
        trials.contacts[i, c] = w.contacts[c]
    for k in range(w.lane, MAX_HAND_DOFS, w.lanes):
        trials.q[i, k] = w.q[k]


@wp.func
def _kept(trials: Trials, i: wp.int32, w: Scratch):
    """Trial i as it was kept."""
    s = trials.motion[i]
    for c in range(w.lane, s.contacts, w.lanes):
        w.contacts[c] = trials.contacts[i, c]
    for k in range(w.lane, MAX_HAND_DOFS, w.lanes):
        w.q[k] = trials.q[i, k]
    meet()
    return s


@wp.kernel(launch_bounds=BLOCKS)
def try_grasps(
    hand: Hand,
    obj: Object,
    course: Course,
    spread: Spread,
    grasps: TriedGrasps,
    each: wp.int32,
    workers: Workers,
    trials: Trials,
    pulls_out: TrialPulls,
):
    """Lanes of a worker, each time with the next trial: close the hand on the object, or pull the object in the next
    ``each`` directions, which ends at the first that is not held.

    One kernel for both, as compilers take long over a phase.

    Args:
        each: 0: close.
        trials: ``row`` and ``draw`` are given, closing writes all else.
    """
    worker, lane = wp.tid()
    w = scratch_of(workers.scratch, worker, lane)
    _describe(hand, w)
    runs = wp.where(each == 0, 1, 6 // wp.max(each, 1))
    number = _next(workers.queue, w)
    while number < runs * trials.row.shape[0]:
        i = number // runs
        first = 2 + number % runs * each
        last = first + each
        s = Motion()
        if each == 0:
            s = _begin(course, spread, grasps, trials, i, hand, w)
            first = 0
        for phase in range(first, last):
            if s.lost == 0 and phase >= 2:
                s = _kept(trials, i, w)
            if s.lost == 0:
                s = _go(hand, obj, course, grasps, trials, i, phase, s, w)
                if phase >= 2 and lane == 0:
                    pulls_out.held[i, phase - 2] = 1 - s.lost
                    pulls_out.displacement[i, phase - 2] = s.displacement
        if each == 0:
            _keep(trials, i, s, w)
        meet()
        number = _next(workers.queue, w)

"""The energy of one quasi-static step of a hand that presses on a free object.

Over the motion dq of the joints and dx of the object (shift of its centre of mass, then turn), base frame,

    E = sum_j huber(q + dq - target; k_j, tau_j) + c_j/2 dq^2  +  M/2 |dx - dx_free|^2 - F dx
      + sum_c kappa/2 min(gap + n y, 0)^2 + huber(|slip + y_t|; kappa, mu f_c)

with y = J dq - (dx moved to the contact): drives, springs that give way at their effort limit tau_j, and their damping,
the object's inertia over the squared time step and its load, contacts that are springs when they close, and friction: a
spring that slips at its bound, the coefficient times the normal force f_c, which is the mean of the points where a link
touches: such a patch is soft and touches between them too. E is convex as long as f_c is held.
"""

import warp as wp

from lgrasp.hand.arrays import Hand
from lgrasp.hold.scratch import Contact, Scratch
from lgrasp.math.kinematics import point_column
from lgrasp.math.limits import MAX_DOFS
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

LIMIT = wp.constant(20.0)
"""Stiffness of joint limits over that of the drive."""
_PATCH = wp.constant(0.005)  # [m] arm at which friction against twisting is as stiff as that against sliding


@wp.struct
class Material:
    """Numbers of one trial."""

    friction: wp.float32
    torsion: wp.float32  # friction against twisting [m]
    contact: wp.float32  # stiffness of a contact [N/m]
    drive: wp.float32  # stiffness of revolute joints [N m/rad]
    drag: wp.float32  # damping of revolute joints over the time step [N m/rad]


@wp.struct
class Body:
    """The object in a step, base frame."""

    com: wp.vec3  # [m]
    mass: wp.float32  # over the squared time step [N/m]
    inertia: wp.mat33  # over the squared time step [N m]
    free: wp.spatial_vector  # its motion if nothing held it [m], [rad]
    force: wp.vec3  # [N]


@wp.func
def make_columns(hand: Hand, w: Scratch, count: wp.int32):
    """Motion of each contact's point on its link [m], and its turn about the normal [rad], per unit of each dof."""
    for c in range(w.lane, count, w.lanes):
        for d in range(MAX_DOFS):
            w.column[c * MAX_DOFS + d] = wp.vec3(0.0)
            w.spin[c * MAX_DOFS + d] = 0.0
        b = w.contacts[c].body
        if b > 0:
            j0 = hand.kin.joint_first[hand.body_group[b]]
            a = b - 1 - j0
            while a >= 0:
                d = hand.kin.joint_dof[j0 + a]
                at = c * MAX_DOFS + d
                w.column[at] = w.column[at] + point_column(hand.kin, j0 + a, w.X[j0 + a], w.contacts[c].point)
                if hand.kin.joint_prismatic[j0 + a] == 0:
                    axis = wp.transform_vector(w.X[j0 + a], hand.kin.joint_axis[j0 + a])
                    w.spin[at] = w.spin[at] + hand.kin.joint_mult[j0 + a] * wp.dot(axis, w.contacts[c].normal)
                a = hand.kin.joint_parent[j0 + a]


@wp.func
def relative_motion(
    hand: Hand,
    contact: Contact,
    c: wp.int32,
    column: wp.array(dtype=wp.vec3),
    spin: wp.array(dtype=wp.float32),
    dq: wp.array(dtype=wp.float32),
    dx: wp.spatial_vector,
    com: wp.vec3,
):
    """Motion of a contact's link against the object [m], and its turn about the normal [rad], as a vec4."""
    w = wp.spatial_bottom(dx)
    y = -wp.spatial_top(dx) - wp.cross(w, contact.point - com)
    t = -wp.dot(w, contact.normal)
    if contact.body > 0:
        g = hand.body_group[contact.body]
        first = hand.kin.dof_first[g]
        for d in range(hand.kin.dof_first[g + 1] - first):
            y += column[c * MAX_DOFS + d] * dq[first + d]
            t += spin[c * MAX_DOFS + d] * dq[first + d]
    return wp.vec4(y[0], y[1], y[2], t)


@wp.func
def friction_stiffness(x: wp.float32, stiffness: wp.float32, limit: wp.float32):
    """Force over slip x >= 0 of a spring that slips at ``limit``."""
    k = stiffness
    if stiffness * x > limit:
        k = limit / x
    return k


@wp.func
def twist_stiffness(m: Material):
    """Of friction against twisting [N m/rad]."""
    return m.contact * _PATCH * _PATCH


@wp.func
def contact_slope(m: Material, contact: Contact, y: wp.vec4, z: wp.vec4):
    """Change of a contact's energy at motion y along z."""
    s = wp.vec3(y[0], y[1], y[2])
    u = wp.vec3(z[0], z[1], z[2])
    yn = wp.dot(contact.normal, s)
    slip = s - contact.normal * yn + contact.slip
    e = friction_stiffness(wp.length(slip), m.contact, m.friction * contact.force) * wp.dot(slip, u)
    if m.torsion > 0.0:
        twist = y[3] + contact.twist
        e += friction_stiffness(wp.abs(twist), twist_stiffness(m), m.torsion * contact.force) * twist * z[3]
    return e + m.contact * wp.min(contact.gap + yn, 0.0) * wp.dot(contact.normal, u)


@wp.func
def spring_effort(m: Material, k: wp.int32, dq: wp.float32, w: Scratch):
    """What the drive of dof k would resist its motion dq with if nothing limited it [N m or N]."""
    return m.drive * w.scale[k] * (w.q[k] + dq - w.target[k])


@wp.func
def drive_effort(m: Material, k: wp.int32, dq: wp.float32, w: Scratch):
    """What the drive of dof k resists its motion dq with [N m or N]: a spring up to its effort limit."""
    return wp.clamp(spring_effort(m, k, dq, w), -w.effort[k], w.effort[k])


@wp.func
def stop_effort(hand: Hand, m: Material, k: wp.int32, dq: wp.float32, w: Scratch):
    """What the stops of dof k resist its motion dq with [N m or N]: 0 within its limits."""
    x = w.q[k] + dq
    over = wp.max(x - hand.kin.dof_upper[k], 0.0) + wp.min(x - hand.kin.dof_lower[k], 0.0)
    return LIMIT * m.drive * w.scale[k] * over

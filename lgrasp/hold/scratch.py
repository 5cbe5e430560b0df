"""Memory that the lanes of a trial share."""

from typing import Any

import warp as wp

from lgrasp.math.limits import MAX_BODIES, MAX_DOFS, MAX_GROUPS
from lgrasp.math.scratch import empty_rows, rows_of
from lgrasp.runtime.device import KERNEL_OPTIONS

wp.set_module_options(KERNEL_OPTIONS)

MAX_TOUCHES = 40
"""Most contacts of a hand and an object."""
MAX_HAND_DOFS = MAX_GROUPS * MAX_DOFS
"""Most dofs of all groups together."""
MAX_TAGS = 4
"""Most contacts of a link."""
_ROWS = MAX_HAND_DOFS + MAX_DOFS  # those of the shared joints come last


@wp.struct
class Contact:
    """Where a link meets the object."""

    body: wp.int32
    tag: wp.int32  # point of the link by which it is known from step to step
    point: wp.vec3  # base frame [m]
    normal: wp.vec3  # of the object, base frame
    gap: wp.float32  # [m]
    force: wp.float32  # along the normal, mean of the patch [N]
    slip: wp.vec3  # across the normal that friction holds against, as a spring does [m]
    twist: wp.float32  # the same about the normal [rad]


@wp.struct
class Terms:
    """Slope and curvature of a contact's energy by the motion of its link."""

    group: wp.int32  # that the link is of; -1: none, or nothing pulls
    f: wp.vec3  # [N]
    H: wp.mat33  # [N/m]
    arm: wp.vec3  # from the object's centre of mass [m]
    turn: wp.float32  # about the normal [N m]
    turn_k: wp.float32  # [N m/rad]


@wp.struct
class Scratch:
    """Of one trial."""

    lane: wp.int32
    lanes: wp.int32
    contacts: wp.array(dtype=Contact)  # (MAX_TOUCHES,)
    before: wp.array(dtype=Contact)  # (MAX_TOUCHES,) those of the step before
    made: wp.array(dtype=Contact)  # (MAX_TAGS,) of one link
    Y: wp.array(dtype=wp.vec4)  # (MAX_TOUCHES,) motion of each contact's link in this step [m], [rad]
    Z: wp.array(dtype=wp.vec4)  # (MAX_TOUCHES,) that of an iteration
    press: wp.array(dtype=wp.float32)  # (MAX_TOUCHES,) forces [N]
    terms: wp.array(dtype=Terms)  # (MAX_TOUCHES,)
    object_rows: wp.array(dtype=wp.spatial_vector)  # (MAX_TOUCHES * 6,) what contacts add to C
    object_slope: wp.array(dtype=wp.float32)  # (MAX_TOUCHES * 6,) and to the object's gradient
    column: wp.array(dtype=wp.vec3)  # (MAX_TOUCHES * MAX_DOFS,) see make_columns
    spin: wp.array(dtype=wp.float32)  # (MAX_TOUCHES * MAX_DOFS,)
    X: wp.array(dtype=wp.transform)  # (MAX_BODIES,) T_base_body of bodies 1, 2, ...
    q: wp.array(dtype=wp.float32)  # (MAX_HAND_DOFS,) [rad or m]
    dq: wp.array(dtype=wp.float32)  # (MAX_HAND_DOFS,) motion in this step
    target: wp.array(dtype=wp.float32)  # (MAX_HAND_DOFS,)
    scale: wp.array(dtype=wp.float32)  # (MAX_HAND_DOFS,) of stiffness, 1 for revolute joints
    effort: wp.array(dtype=wp.float32)  # (MAX_HAND_DOFS,) limit of what the drive presses with [N m or N]
    group: wp.array(dtype=wp.int32)  # (MAX_HAND_DOFS,) of each dof
    step: wp.array(dtype=wp.float32)  # (rows,) gradient, then step of an iteration
    A: wp.array(dtype=wp.float32)  # (rows * MAX_DOFS,) see lgrasp.hold.system
    B: wp.array(dtype=wp.spatial_vector)  # (rows,)
    b: wp.array(dtype=wp.float32)  # (rows,)
    C: wp.array(dtype=wp.spatial_vector)  # (6,)
    c: wp.array(dtype=wp.float32)  # (6,)
    slope: wp.array(dtype=wp.float32)  # (6,) the object's gradient


Scratches, scratch_of = rows_of(Scratch)

_SIZES = {
    **dict.fromkeys(("contacts", "before", "Y", "Z", "press", "terms"), MAX_TOUCHES),
    **dict.fromkeys(("column", "spin"), MAX_TOUCHES * MAX_DOFS),
    **dict.fromkeys(("q", "dq", "target", "scale", "effort", "group"), MAX_HAND_DOFS),
    "made": MAX_TAGS,
    **dict.fromkeys(("object_rows", "object_slope"), MAX_TOUCHES * 6),
    "X": MAX_BODIES,
    **dict.fromkeys(("step", "B", "b"), _ROWS),
    "A": _ROWS * MAX_DOFS,
    **dict.fromkeys(("C", "c", "slope"), 6),
}


def empty_scratches(workers: int, device: str) -> Any:
    """Memory for as many trials at a time."""
    return empty_rows(Scratches, workers, _SIZES, device)

"""What the kernels of the checks are given: bounds, hands before an object, their contacts, and what is found."""

import math

import warp as wp

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.outcomes import MEASURED
from lgrasp.math.kinematics import vec_dof
from lgrasp.runtime.structs import make_struct, params_struct

Limits = params_struct(
    *("Limits", __name__, GraspBounds),
    min_cosine=wp.float32,  # of opposed normals
    min_spread_cosine=wp.float32,  # of the object's normals about a contact
    deepest=wp.float32,  # [m] penetrations above this are not distinguished
    whole=wp.int32,  # 1: rows that failed are measured to the end
)
""":class:`~lgrasp.grasp.bounds.GraspBounds` on a device."""


@wp.struct
class CheckedPostures:
    """n hands before an object: groups G, bodies B, joints K; at most C contacts each."""

    pose: wp.array(dtype=wp.transform)  # (P,) T_hand_object of the internal frame
    index: wp.array(dtype=wp.int32)  # (P,) candidate, which tells what the hand holds already
    resting: wp.array(dtype=wp.int32)  # (P,) resting pose of the object, -1 none
    of: wp.array(dtype=wp.int32)  # (n,) pose of each
    slot: wp.array(dtype=wp.int32)  # (n,)
    chosen: wp.array2d(dtype=wp.int32)  # (n, G) -1: the group does not touch the object
    body: wp.array2d(dtype=wp.transform)  # (n, B - 1) T_hand_body of all but the base
    posture: wp.array2d(dtype=vec_dof)  # (n, G) [rad or m]
    contact: wp.array2d(dtype=wp.int32)  # (n, C) place on the hand, -1 none
    surface: wp.array2d(dtype=wp.int32)  # (n, C) place on the object, -1 none


@wp.struct
class Places:
    """Where contacts may be: h places on the hand, o on the object."""

    link: wp.array(dtype=wp.int32)  # (h,) index in link_names
    body: wp.array(dtype=wp.int32)  # (h,)
    grid: wp.array(dtype=wp.int32)  # (h,) mesh of the link, -1 none
    points: wp.array(dtype=wp.vec3)  # (o,) object's internal frame [m]
    normals: wp.array(dtype=wp.vec3)  # (o,) outward


@wp.struct
class Findings:
    """Findings on n hands."""

    outcome: wp.array(dtype=wp.int32)  # (n,) Outcome
    numbers: wp.array2d(dtype=wp.float32)  # (6, n) MEASURED
    gap: wp.array(dtype=wp.float32)  # (n,) its rows, by name
    facing: wp.array(dtype=wp.float32)  # (n,)
    fswo: wp.array(dtype=wp.float32)  # (n,)
    gswo: wp.array(dtype=wp.float32)  # (n,)
    unresisted_load: wp.array(dtype=wp.float32)  # (n,)
    penetration: wp.array(dtype=wp.float32)  # (n,)
    force: wp.array2d(dtype=wp.vec3)  # (n, C) object's frame, normal parts add up to 1


@wp.struct
class Packed:
    """m rows as they are stored, called as in :class:`~lgrasp.grasp.tables.GraspTable`."""

    index: wp.array(dtype=wp.int32)  # (m,)
    slot: wp.array(dtype=wp.int32)  # (m,)
    q: wp.array2d(dtype=wp.float32)  # (m, K) [rad or m]
    q_pregrasp: wp.array2d(dtype=wp.float32)  # (m, K)
    q_squeeze: wp.array2d(dtype=wp.float32)  # (m, K)
    pose: wp.array(dtype=wp.transform)  # (m,)
    contact_points: wp.array2d(dtype=wp.vec3)  # (m, C) NaN where there is no contact
    contact_normals: wp.array2d(dtype=wp.vec3)  # (m, C)
    contact_links: wp.array2d(dtype=wp.int32)  # (m, C) -1 where there is no contact
    contact_forces: wp.array2d(dtype=wp.vec3)  # (m, C)
    numbers: wp.array2d(dtype=wp.float32)  # (6, m) MEASURED
    epsilon: wp.array(dtype=wp.float32)  # (m,)
    self_penetration: wp.array(dtype=wp.float32)  # (m,) [m]
    pregrasp_opening: wp.array(dtype=wp.float32)  # (m,) [rad or m]
    squeeze_travel: wp.array(dtype=wp.float32)  # (m,) [m]
    squeeze_force: wp.array(dtype=wp.float32)  # (m,) [N]
    stable_squeeze: wp.array(dtype=wp.float32)  # (m,) [N]
    closing_travel: wp.array(dtype=wp.float32)  # (m,) [rad or m]
    closing_penetration: wp.array(dtype=wp.float32)  # (m,) [m]
    closing_sweep: wp.array(dtype=wp.float32)  # (m,) [m]
    resting: wp.array(dtype=wp.int32)  # (m,) resting pose of the object; only where there is a table, as the next
    approach: wp.array(dtype=wp.vec3)  # (m,) direction in which the open hand comes, base frame; NaN none


def device_limits(bounds: GraspBounds, *, deepest: float | None = None) -> Limits:
    """Bounds for kernels.

    Args:
        deepest: measure every row to the end, penetrations up to this [m]; None: a row's first failure ends it.
    """
    return make_struct(
        Limits,
        bounds,
        min_cosine=math.cos(math.radians(bounds.max_normal_angle)),
        min_spread_cosine=math.cos(math.radians(bounds.max_normal_spread)),
        deepest=bounds.max_penetration if deepest is None else deepest,
        whole=int(deepest is not None),
    )


def new_findings(n: int, width: int, device: str) -> Findings:
    """Room for the findings on n hands with ``width`` contacts at most."""
    numbers = wp.zeros((len(MEASURED), max(n, 1)), dtype=wp.float32, device=device)
    return make_struct(
        Findings,
        outcome=wp.zeros(n, dtype=wp.int32, device=device),
        numbers=numbers,
        force=wp.zeros((n, width), dtype=wp.vec3, device=device),
        **{name: numbers[i] for i, name in enumerate(MEASURED)},
    )

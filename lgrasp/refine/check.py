"""Finished grasps of hands in a posture: contacts found, every claim computed on the final joints, control poses."""

import math

import numpy as np
import warp as wp

from lgrasp.grasp.bounds import GraspBounds
from lgrasp.grasp.tables import GraspTable
from lgrasp.hand.arrays import HandArrays
from lgrasp.math.qp import MAX_CONTACTS
from lgrasp.object.arrays import ObjectArrays
from lgrasp.refine.check_kernels import (
    balance_rows,
    choose_contacts,
    clear_of_itself,
    control_rows,
    deepen_rows,
    link_contacts,
)
from lgrasp.refine.surface import Palmar, ruled_palmar

OUTCOMES = ("kept", "contact", "self-collision", "object collision", "balance", "unresisted load")
"""Outcome codes of a row: the first check that it failed."""

_FAR = 0.03  # [m] depths above this are of no account


def check_grasps(
    hand: HandArrays,
    obj: ObjectArrays,
    pose: np.ndarray,
    q: np.ndarray,
    bounds: GraspBounds,
    *,
    palmar: Palmar | None = None,
    around: ObjectArrays | None = None,
    index: np.ndarray | None = None,
) -> tuple[GraspTable, np.ndarray]:
    """All rows as a table in the order given, and their outcomes (OUTCOMES), (N,).

    Args:
        pose: T_hand_object of the object's internal frame, device poses (N, 7).
        q: joint positions within their limits [rad or m], (N, K).
        palmar: where the hand may touch; default: where hand.yaml lets it.
        around: what else the hand must not penetrate, in the object's internal frame.
        index: candidate index of each row; default: the row.
    """
    d, n = hand.device, len(q)
    side = palmar or ruled_palmar(hand.model)
    runs = _link_runs(side.link)
    links, width = len(runs) - 1, contact_width(side.link)
    run_body = wp.array(side.body[runs[:-1]].astype(np.int32), dtype=wp.int32, device=d)
    poses = wp.array(np.ascontiguousarray(pose, np.float32), dtype=wp.transform, device=d)
    joints = wp.array(np.ascontiguousarray(q, np.float32), dtype=wp.float32, device=d)
    contact = wp.empty((n, links), dtype=wp.int32, device=d)
    gap, dot = (wp.zeros((n, links), dtype=wp.float32, device=d) for _ in range(2))
    point, normal = (wp.zeros((n, links), dtype=wp.vec3, device=d) for _ in range(2))
    wp.launch(
        link_contacts,
        dim=(links, n),
        inputs=[
            hand.struct,
            obj.struct,
            wp.array(side.points.astype(np.float32), dtype=wp.vec3, device=d),
            wp.array(side.normals.astype(np.float32), dtype=wp.vec3, device=d),
            wp.array(runs, dtype=wp.int32, device=d),
            run_body,
            bounds.max_gap,
            math.cos(math.radians(bounds.max_normal_angle)),
            math.cos(math.radians(bounds.max_normal_spread)),
            poses,
            joints,
        ],
        outputs=[contact, gap, dot, point, normal],
        device=d,
    )
    chosen = wp.empty((n, width), dtype=wp.int32, device=d)
    groups, clear = (wp.empty(n, dtype=wp.int32, device=d) for _ in range(2))
    overlap = wp.empty(n, dtype=wp.float32, device=d)
    wp.launch(choose_contacts, dim=n, inputs=[hand.struct, run_body, contact, gap], outputs=[chosen, groups], device=d)
    body = wp.empty((n, len(hand.model.piece_first) - 2), dtype=wp.transform, device=d)
    wp.launch(
        clear_of_itself,
        dim=n,
        inputs=[hand.struct, bounds.min_self_distance, joints],
        outputs=[body, clear, overlap],
        device=d,
    )
    depth = wp.zeros(n, dtype=wp.float32, device=d)
    for solid in (obj, around):
        if solid is not None:
            wp.launch(
                deepen_rows,
                dim=(len(hand.model.piece_first) - 1, n),
                inputs=[hand.struct, solid.struct, _FAR, poses, joints],
                outputs=[depth],
                device=d,
            )
    force = wp.zeros((n, width), dtype=wp.vec3, device=d)
    numbers = wp.zeros((4, n), dtype=wp.float32, device=d)
    wp.launch(
        balance_rows,
        dim=n,
        inputs=[obj.struct, 0, bounds.friction, bounds.torque_scale, poses, chosen, point, normal],
        outputs=[force, numbers],
        device=d,
    )
    pregrasp, squeeze = wp.clone(joints), wp.clone(joints)
    wp.launch(
        control_rows,
        dim=n,
        inputs=[
            hand.struct,
            obj.struct,
            bounds.pregrasp_distance,
            bounds.min_pregrasp_distance,
            bounds.min_self_distance,
            bounds.squeeze_force,
            bounds.squeeze_stiffness,
            poses,
            joints,
            body,
            chosen,
            run_body,
            point,
            normal,
            force,
        ],
        outputs=[pregrasp, squeeze],
        device=d,
    )
    at = chosen.numpy()
    filled = at >= 0
    fswo, gswo, disturbance, epsilon = numbers.numpy()
    deep = depth.numpy()
    outcome = np.select(
        [
            groups.numpy() < 2,
            clear.numpy() == 0,
            deep > bounds.max_penetration,
            gswo > bounds.max_gswo,
            disturbance > bounds.max_unresisted_load,
        ],
        range(1, len(OUTCOMES)),
        0,
    )

    def column(values: wp.array, none: float) -> np.ndarray:
        """A column by link as one by contact."""
        v = values.numpy()
        picked = np.take_along_axis(v, np.where(filled, at, 0).reshape(at.shape + (1,) * (v.ndim - 2)), 1)
        return np.where(filled.reshape(picked.shape[:2] + (1,) * (v.ndim - 2)), picked, none).astype(v.dtype)

    hit = column(contact, 0)
    metrics = {
        "fswo": fswo,
        "gswo": gswo,
        "unresisted_load": disturbance,
        "epsilon": epsilon,
        "penetration": deep,
        "self_penetration": overlap.numpy(),
        "gap": column(gap, 0).max(1, initial=0),
        "normal_error": np.arccos(np.clip(column(dot, 1).min(1, initial=1), -1, 1)),
    }
    table = GraspTable(
        index=np.arange(n) if index is None else np.asarray(index, np.int64),
        slot=np.zeros(n, np.int32),
        q=joints.numpy(),
        q_pregrasp=pregrasp.numpy(),
        q_squeeze=squeeze.numpy(),
        pose=np.ascontiguousarray(pose, np.float32),
        contact_points=column(point, np.nan),
        contact_normals=column(normal, np.nan),
        contact_links=np.where(filled, side.link[hit], -1).astype(np.int32),
        contact_forces=np.where(filled[..., None], force.numpy(), np.nan),
        metrics={name: values.astype(np.float32) for name, values in metrics.items()},
    )
    return table, outcome


def contact_width(contact_link: np.ndarray) -> int:
    """Most contacts of a row of :func:`check_grasps`, by the links of a hand's contact points."""
    return min(MAX_CONTACTS, len(_link_runs(contact_link)) - 1)


def _link_runs(contact_link: np.ndarray) -> np.ndarray:
    """First contact point of each run of points on one link, and their number."""
    return np.concatenate([[0], np.flatnonzero(np.diff(contact_link)) + 1, [len(contact_link)]]).astype(np.int32)

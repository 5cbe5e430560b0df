"""The one conversion of tables of grasps to rows of a shard: internal frames and joints become the user's."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lgrasp.geometry.poses import user_poses
from lgrasp.grasp.outcomes import FAILED_BOUNDS
from lgrasp.grasp.records import CODE, GraspRows
from lgrasp.grasp.schema import POSTURES
from lgrasp.grasp.tables import CONTACTS, GraspTable
from lgrasp.hand.tree import Tree

METRIC_UNITS = {
    **dict.fromkeys(("penetration", "self_penetration", "gap"), "m"),
    "normal_error": "rad",
    "pregrasp_opening": "rad or m",
    "squeeze_travel": "m",
    "squeeze_force": "N",
    "stable_squeeze": "N",
    "closing_travel": "rad or m",
    "closing_penetration": "m",
    "closing_sweep": "m",
    "hold_drift": "m",
    "failed_bound": CODE + ", ".join(f"{code} {name}" for code, name in enumerate(FAILED_BOUNDS)),
}
"""Unit of each metric that has one."""

SHARD_BITS = 40
"""Bits of the column ``candidate`` below the number of the shard."""
_MIN_FORCE_SHARE = 1e-3  # of the normal forces together, which are 1


def grasp_rows(
    table: GraspTable,
    tree: Tree,
    center: np.ndarray,
    *,
    shard: int = 0,
    extra: Mapping[str, np.ndarray] | None = None,
    protocol: str = "",
) -> GraspRows:
    """Grasps of one object.

    Args:
        center: origin of the object's internal frame in the user's [m], (3,) f32.
        extra: further metrics, (N,) each.
    """
    postures, contacts = ({n: getattr(table, n)[:, None] for n in names} for names in (POSTURES, CONTACTS))
    columns = step_columns(tree, postures, table.pose[:, None], contacts, center[None])
    links = columns["contact_links"]
    width = used_width(links)
    shared: dict[str, Any] = {name: columns[name][:, 0] for name in POSTURES}
    shared |= {name: columns[name][:, :, :width] for name in CONTACTS}
    return GraspRows(
        **shared,
        object_pose=columns["object_pose"],
        object_index=np.zeros((len(table), 1), np.int32),
        candidate=row_numbers(shard, table.index),
        metrics={**table.metrics, "contacts": (links >= 0).sum((1, 2)).astype(np.float32), **(extra or {})},
        metric_units=METRIC_UNITS,
        physics=table.physics,
        physics_protocols=dict.fromkeys(table.physics, protocol),
        table=table.table,
    )


def step_columns(
    tree: Tree,
    postures: Mapping[str, np.ndarray],
    pose: np.ndarray,
    contacts: Mapping[str, np.ndarray],
    centers: np.ndarray,
) -> dict[str, np.ndarray]:
    """Joints, poses and contacts of rows of S objects each, as a shard has them.

    Args:
        postures: joints of the hand's groups in each step by name, (N, S, K).
        pose: T_hand_object of the internal frames, x y z, qx qy qz qw, (N, S, 7).
        contacts: ``contact_points``, ``_normals``, ``_forces`` (N, S, C, 3) and ``contact_links`` (N, S, C), NaN and -1
            padding.
        centers: origin of each object's internal frame in the user's [m], (S, 3) f32.
    """
    steps = range(len(centers))
    return {
        **contacts,
        **{name: np.stack([tree.listed_values(q[:, s]) for s in steps], 1) for name, q in postures.items()},
        "object_pose": np.stack([user_poses(pose[:, s], centers[s]) for s in steps], 1),
        "contact_points": contacts["contact_points"] + centers[:, None],
        "contact_links": contacts["contact_links"].astype(np.int16),
    }


def used_width(links: np.ndarray) -> int:
    """Contacts that a file has room for: up to the last that any row uses, at least one; ``links`` is (N, S, C)."""
    return int(np.flatnonzero((links >= 0).any((0, 1))).max(initial=0)) + 1


def row_numbers(shard: int, index: np.ndarray) -> np.ndarray:
    """Global candidate index: the shard and the candidate in its stream."""
    return (np.uint64(shard) << np.uint64(SHARD_BITS)) + index.astype(np.uint64)


def press(table: GraspTable) -> GraspTable:
    """The table with forces whose normal parts sum to 1 in every row; one whose contacts do not press has none."""
    normal = -np.nansum(table.contact_forces * table.contact_normals, axis=(1, 2))
    # a single contact carries no force: a row has contacts that press against each other, or none
    filled = (table.contact_links >= 0) & (normal > _MIN_FORCE_SHARE)[:, None]
    forces = table.contact_forces / np.maximum(normal, _MIN_FORCE_SHARE)[:, None, None]

    def where(values: np.ndarray) -> np.ndarray:
        return np.where(filled[..., None], values, np.nan).astype(np.float32)

    return replace(
        table,
        contact_points=where(table.contact_points),
        contact_normals=where(table.contact_normals),
        contact_links=np.where(filled, table.contact_links, -1),
        contact_forces=where(forces),
    )

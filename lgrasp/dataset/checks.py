"""Conditions on the values of a shard; used before writing and when validating."""

from collections.abc import Sequence

import numpy as np

from lgrasp.dataset.lineage import Column, check_parents, check_steps
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord

_LIMIT_TOLERANCE = 1e-4  # rad or m
_UNIT_TOLERANCE = 1e-3  # of quaternion and normal lengths, and of the sum of normal forces


def hand_problems(hand: HandRecord) -> list[str]:
    """Problems of a hand's values: limits that are NaN or crossed, repeated names, no URDF."""
    problems = []
    lower, upper = np.asarray(hand.joint_lower), np.asarray(hand.joint_upper)
    if not np.all(lower <= upper):  # NaN fails too
        joint = int(np.argmin(lower <= upper))
        problems.append(f"hand: joint {hand.joint_names[joint]!r} has limits [{lower[joint]}, {upper[joint]}]")
    for what, names in (("joint_names", hand.joint_names), ("link_names", hand.link_names)):
        if len(set(names)) != len(names):
            problems.append(f"hand/{what}: names repeat")
    if "<robot" not in hand.urdf:
        problems.append("hand/urdf: holds no <robot> element")
    return problems


def object_problems(record: ObjectRecord) -> list[str]:
    """Problems of an object's values: vertices not finite, faces out of range, normals, scale not positive."""
    where, problems = f"objects/{record.id}", []
    if not np.isfinite(record.vertices).all():
        problems.append(f"{where}/vertices: not finite")
    faces = np.asarray(record.faces)
    if faces.size and (faces.min() < 0 or faces.max() >= len(record.vertices)):
        bad = int(faces.min() if faces.min() < 0 else faces.max())
        problems.append(f"{where}/faces: index {bad}, there are {len(record.vertices)} vertices")
    if record.normals is not None:
        if np.shape(record.normals) != np.shape(record.vertices):
            problems.append(f"{where}/normals: {len(record.normals)} for {len(record.vertices)} vertices")
        elif not (np.abs(np.linalg.norm(record.normals, axis=-1) - 1) <= _UNIT_TOLERANCE).all():  # NaN fails too
            problems.append(f"{where}/normals: not of unit length")
    if not 0 < record.scale < np.inf:
        problems.append(f"{where}: scale is {record.scale}, must be positive")
    return problems


def row_problems(
    rows: GraspRows, hand: HandRecord, object_ids: Sequence[str], column: Column, *, first_row: int = 0
) -> list[str]:
    """Problems of the values of some rows, one line per kind of problem, naming the first row that has it.

    Args:
        rows: Rows with the shapes and dtypes of the format.
        hand: The hand they belong to.
        object_ids: The shard's sorted object ids.
        column: Rows of the whole shard by flat name, for rows of sequences, which refer to others.
        first_row: Index of ``rows[0]`` in the shard, for the messages.
    """
    problems: list[str] = []

    def require(good: np.ndarray, text: str) -> None:
        bad = np.flatnonzero(~good.all(axis=tuple(range(1, good.ndim))))
        if len(bad):
            problems.append(f"grasps/{text} (row {first_row + bad[0]}, {len(bad)} rows)")

    with np.errstate(invalid="ignore", over="ignore"):
        _check_joints(rows, hand, require)
        _check_poses(rows, len(object_ids), require)
        _check_contacts(rows, len(hand.link_names), require)
        if rows.sequence is not None:
            check_steps(rows, rows.sequence, *_limits(hand), require)
            check_parents(rows, rows.sequence, column, first_row, require)
    return problems


def _check_joints(rows: GraspRows, hand: HandRecord, require) -> None:
    for name in ("q", "q_pregrasp", "q_squeeze"):
        require(np.isfinite(getattr(rows, name)), f"{name}: not finite")
    lower, upper = _limits(hand)
    require(~((rows.q < lower) | (rows.q > upper)), "q: outside the joint limits by more than 1e-4")


def _limits(hand: HandRecord) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest joint positions that are accepted, shape [K] each."""
    return np.asarray(hand.joint_lower) - _LIMIT_TOLERANCE, np.asarray(hand.joint_upper) + _LIMIT_TOLERANCE


def _check_poses(rows: GraspRows, objects: int, require) -> None:
    index, pose = rows.object_index, rows.object_pose
    present = index >= 0  # (n, o)
    require((index >= -1) & (index < objects), f"object_index: must be -1 to {objects - 1}")
    require(present.any(axis=1), "object_index: no object is present")
    require(np.where(present[..., None], np.isfinite(pose), np.isnan(pose)), "object_pose: NaN if and only if absent")
    norm = np.linalg.norm(pose[..., 3:], axis=-1)
    require(~present | (np.abs(norm - 1) <= _UNIT_TOLERANCE), "object_pose: quaternion is not of unit length")
    require(~present | (pose[..., 3] >= 0), "object_pose: quaternion has w < 0")


def _check_contacts(rows: GraspRows, links: int, require) -> None:
    link = rows.contact_links
    contact = link >= 0  # (n, o, c)
    require((link >= -1) & (link < links), f"contact_links: must be -1 to {links - 1}")
    require(~contact | (rows.object_index >= 0)[..., None], "contact_links: contact with an absent object")
    for name in ("contact_points", "contact_normals", "contact_forces"):
        values = getattr(rows, name)
        good = np.where(contact[..., None], np.isfinite(values), np.isnan(values))
        require(good, f"{name}: NaN if and only if contact_links is -1")
    norm = np.linalg.norm(rows.contact_normals, axis=-1)
    require(~contact | (np.abs(norm - 1) <= _UNIT_TOLERANCE), "contact_normals: not of unit length")
    normal_part = -(rows.contact_forces * rows.contact_normals).sum(axis=-1)  # (n, o, c)
    total = np.where(contact, normal_part, 0).sum(axis=-1)
    good = ~contact.any(axis=-1) | (np.abs(total - 1) <= _UNIT_TOLERANCE)
    require(good, "contact_forces: normal parts (-force . normal) of an object's contacts do not sum to 1")

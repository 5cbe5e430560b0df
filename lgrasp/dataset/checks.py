"""Conditions on the values of a shard; used before writing and when validating."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lgrasp.errors import HandError, ShardError
from lgrasp.grasp.hand_files import lacks
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord, SequenceRows
from lgrasp.grasp.schema import CHUNK_ROWS
from lgrasp.hand.urdf import MOVABLE, parse_robot
from lgrasp.math.constants import LIMIT_EXCESS

Column = Callable[[str, int, int], np.ndarray]
"""Rows of the whole file by flat name, first row and the row after the last, as :meth:`ShardReader.column`."""
Require = Callable[[Any, str], None]
"""Called with what is good, shape [n, ...], and the text of the problem if some is not."""

_UNIT_TOLERANCE = 1e-3  # of quaternion and normal lengths, and of the sum of normal forces
_HELD = {"q": "q", "q_pregrasp": "q", "q_squeeze": "q_squeeze"}
"""Where joints that a step does not move are: in which control pose of the step before."""
_INHERITED = (
    *("object_index", "object_pose", "contact_points", "contact_normals", "contact_links", "contact_forces"),
    *(f"sequence/{name}" for name in ("space", "free_joints", *_HELD)),
)


def requirer(problems: list[str], where: str = "", first_row: int = 0) -> Require:
    """What adds a line on a condition that rows do not meet, naming the first such row."""

    def require(good: Any, text: str) -> None:
        bad = np.flatnonzero(~np.asarray(good).all(axis=tuple(range(1, np.ndim(good)))))
        if len(bad):
            problems.append(f"{where}{text} (row {first_row + bad[0]}, {len(bad)} rows)")

    return require


def are_unit(vectors: np.ndarray) -> np.ndarray:
    """Which vectors (or quaternions), shape [..., d], have unit length; NaN has not."""
    return np.abs(np.linalg.norm(vectors, axis=-1) - 1) <= _UNIT_TOLERANCE


def accepted_limits(hand: HandRecord) -> tuple[np.ndarray, np.ndarray]:
    """Least and largest joint positions that are accepted, shape [K] each."""
    return np.asarray(hand.joint_lower) - LIMIT_EXCESS, np.asarray(hand.joint_upper) + LIMIT_EXCESS


def hand_problems(hand: HandRecord) -> list[str]:
    """Problems of a hand's values: limits that are NaN or crossed, repeated names, no URDF, or one without them."""
    problems = []
    lower, upper = np.asarray(hand.joint_lower), np.asarray(hand.joint_upper)
    if not np.all(lower <= upper):  # NaN fails too
        joint = int(np.argmin(lower <= upper))
        problems.append(f"hand: joint {hand.joint_names[joint]!r} has limits [{lower[joint]}, {upper[joint]}]")
    for what, names in (("joint_names", hand.joint_names), ("link_names", hand.link_names)):
        if len(set(names)) != len(names):
            problems.append(f"hand/{what}: names repeat")
    return problems + _urdf_problems(hand)


def _urdf_problems(hand: HandRecord) -> list[str]:
    try:
        robot, _ = parse_robot(Path("hand/urdf"), hand.urdf.encode())
    except HandError as error:
        return [str(error)]
    links = {link.get("name") for link in robot.iterfind("link")}
    movable = {joint.get("name") for joint in robot.iterfind("joint") if joint.get("type") in MOVABLE}
    if not links:  # shards of earlier releases may have a URDF without any
        return []
    return [f"{where}: {lack}" for where, lack in lacks(hand, links, movable)]


def object_problems(record: ObjectRecord) -> list[str]:
    """Problems of an object's values: no vertices or not finite ones, faces, normals, planes, regions, scale."""
    where, problems = f"objects/{record.id}", []
    if not np.isfinite(record.vertices).all():
        problems.append(f"{where}/vertices: not finite")
    if not len(record.vertices):
        problems.append(f"{where}/vertices: none")
    if not len(record.faces) and record.normals is None:
        problems.append(f"{where}: neither faces, as of a mesh, nor normals, as of a point cloud")
    faces = np.asarray(record.faces)
    if faces.size and (faces.min() < 0 or faces.max() >= len(record.vertices)):
        bad = int(faces.min() if faces.min() < 0 else faces.max())
        problems.append(f"{where}/faces: index {bad}, there are {len(record.vertices)} vertices")
    if record.normals is not None:
        if np.shape(record.normals) != np.shape(record.vertices):
            problems.append(f"{where}/normals: {len(record.normals)} for {len(record.vertices)} vertices")
        elif not are_unit(record.normals).all():
            problems.append(f"{where}/normals: not of unit length")
    if record.tables is not None:
        if not (are_unit(record.tables[:, :3]) & np.isfinite(record.tables).all(1)).all():
            problems.append(f"{where}/tables: a normal is not of unit length, or a number not finite")
        if ((record.tables[:, 4] < 0) | (record.tables[:, 4] > 1)).any():
            problems.append(f"{where}/tables: a probability is not from 0 to 1")
    if record.regions is not None:
        weights = record.regions[:, 3:]
        if not np.isfinite(record.regions).all() or not ((weights >= 0) & (weights <= 1)).all():
            problems.append(f"{where}/regions: a number is not finite, or a weight not from 0 to 1")
        if not 0 < record.touch_share <= 1:
            problems.append(f"{where}: touch_share is {record.touch_share}, must be above 0, at most 1")
    if not 0 < record.scale < np.inf:
        problems.append(f"{where}: scale is {record.scale}, must be positive")
    return problems


def row_problems(
    rows: GraspRows, hand: HandRecord, objects: Sequence[ObjectRecord], column: Column, *, first_row: int = 0
) -> list[str]:
    """Problems of the values of some rows, one line per kind of problem, naming the first row that has it.

    Args:
        rows: Rows with the shapes and dtypes of the format.
        objects: The shard's objects, sorted by id.
        column: Rows of the whole shard, for rows of sequences, which refer to others.
        first_row: Index of ``rows[0]`` in the shard.
    """
    problems: list[str] = []
    require, limits = requirer(problems, "grasps/", first_row), accepted_limits(hand)
    with np.errstate(invalid="ignore", over="ignore"):
        for name in _HELD:
            require(np.isfinite(getattr(rows, name)), f"{name}: not finite")
        require(~((rows.q < limits[0]) | (rows.q > limits[1])), "q: outside the joint limits by more than 1e-4")
        _check_poses(rows, len(objects), require)
        _check_contacts(rows, len(hand.link_names), require)
        if rows.table:
            planes = np.array([0 if record.tables is None else len(record.tables) for record in objects])
            index = np.clip(rows.object_index, -1, len(planes) - 1)  # (n, o)
            pose, known = rows.table["pose"], np.where(index >= 0, planes[index], np.inf).min(axis=1, initial=np.inf)
            require((pose >= 0) & (pose < known), "table/pose: not a row of the object's tables")
            require(are_unit(rows.table["approach"]), "table/approach: not of unit length")
        if rows.sequence is not None:
            _check_steps(rows, rows.sequence, *limits, require)
            _check_parents(rows, rows.sequence, column, first_row, require)
    return problems


def refuse_problems(
    path: Path,
    rows: GraspRows,
    hand: HandRecord,
    objects: Sequence[ObjectRecord],
    column: Column,
    use: str,
    *,
    first_row: int = 0,
) -> None:
    """Raise ShardError if some rows of a file have :func:`row_problems`; ``use``: what cannot be done with them."""
    if problems := row_problems(rows, hand, objects, column, first_row=first_row):
        raise ShardError(f"{path}: {problems[0]}; grasps as 'lgrasp dataset check' accepts them can be {use}")


def refuse_not_finite(
    path: Path, object_index: np.ndarray, object_pose: np.ndarray, joints: Mapping[str, np.ndarray], first_row: int
) -> None:
    """Raise ShardError if some rows (n,) of a file have joints (n, K) by name, or poses (n, O, 7) of objects that are
    there, index (n, O), which are not finite."""
    problems: list[str] = []
    require = requirer(problems, "grasps/", first_row)
    for name, values in joints.items():
        require(np.isfinite(values), f"{name}: not finite")
    require((object_index < 0)[..., None] | np.isfinite(object_pose), "object_pose: not finite")
    if problems:
        raise ShardError(f"{path}: {problems[0]}")


def _check_poses(rows: GraspRows, objects: int, require: Require) -> None:
    index, pose = rows.object_index, rows.object_pose
    present = index >= 0  # (n, o)
    require((index >= -1) & (index < objects), f"object_index: must be -1 to {objects - 1}")
    require(present.any(axis=1), "object_index: no object is present")
    require(np.where(present[..., None], np.isfinite(pose), np.isnan(pose)), "object_pose: NaN if and only if absent")
    require(~present | are_unit(pose[..., 3:]), "object_pose: quaternion is not of unit length")
    require(~present | (pose[..., 3] >= 0), "object_pose: quaternion has w < 0")


def _check_contacts(rows: GraspRows, links: int, require: Require) -> None:
    link = rows.contact_links
    contact = link >= 0  # (n, o, c)
    require((link >= -1) & (link < links), f"contact_links: must be -1 to {links - 1}")
    require(~contact | (rows.object_index >= 0)[..., None], "contact_links: contact with an absent object")
    for name in ("contact_points", "contact_normals", "contact_forces"):
        values = getattr(rows, name)
        good = np.where(contact[..., None], np.isfinite(values), np.isnan(values))
        require(good, f"{name}: NaN if and only if contact_links is -1")
    require(~contact | are_unit(rows.contact_normals), "contact_normals: not of unit length")
    normal_part = -(rows.contact_forces * rows.contact_normals).sum(axis=-1)  # (n, o, c)
    require(~contact | (normal_part >= -_UNIT_TOLERANCE), "contact_forces: a force points out of the object")
    total = np.where(contact, normal_part, 0).sum(axis=-1)
    good = ~contact.any(axis=-1) | (np.abs(total - 1) <= _UNIT_TOLERANCE)
    require(good, "contact_forces: normal parts (-force . normal) of an object's contacts do not sum to 1")


def _check_steps(rows: GraspRows, steps: SequenceRows, lower: np.ndarray, upper: np.ndarray, require: Require) -> None:
    """Check rows of sequences, each by itself."""
    present = rows.object_index >= 0  # (n, o)
    space, free, spaces = steps.space, steps.free_joints, len(steps.space_names)
    require(present[:, :-1] | ~present[:, 1:], "object_index: in a sequence, absent objects must be the last")
    require((space >= 0) == present, "sequence/space: -1 if and only if the object is absent")
    require((space >= -1) & (space < spaces), f"sequence/space: must be -1 to {spaces - 1}")
    if len(set(steps.space_names)) != spaces:
        require(np.zeros(len(rows), bool), "sequence/space_names: names repeat")
    order = np.sort(space, axis=1)
    require((order[:, 1:] != order[:, :-1]) | (order[:, 1:] < 0), "sequence/space: a space is used twice")
    require(free.any(2) == present, "sequence/free_joints: a step must move a joint, and an absent one none")
    require(free.sum(1) <= 1, "sequence/free_joints: two steps move one joint")
    frozen = present[:, 1:, None] & ~free[:, 1:]  # (n, o - 1, k)
    last = np.maximum(present.sum(1) - 1, 0)
    for name, held in _HELD.items():
        values = getattr(steps, name)  # (n, o, k)
        good = np.where(present[..., None], np.isfinite(values), np.isnan(values))
        require(good, f"sequence/{name}: NaN if and only if the object is absent")
        require(getattr(rows, name) == values[np.arange(len(last)), last], f"{name}: not that of the last step")
        kept = ~frozen | (values[:, 1:] == getattr(steps, held)[:, :-1])
        require(kept, f"sequence/{name}: a joint that the step does not move is not at {held} of the step before")
    require(~((steps.q < lower) | (steps.q > upper)), "sequence/q: outside the joint limits by more than 1e-4")


def _check_parents(rows: GraspRows, steps: SequenceRows, column: Column, first_row: int, require: Require) -> None:
    """Check rows of sequences against the rows that they extend, and against the order of rows."""
    count = (rows.object_index >= 0).sum(1)
    before = (column("object_index", max(first_row - 1, 0), first_row) >= 0).sum(1)
    order = np.concatenate([before if first_row else count[:1], count])
    require(order[1:] >= order[:-1], "object_index: in sequences, rows of fewer objects must come first")
    number = first_row + np.arange(len(count))
    parent = steps.parent
    require((parent >= 0) == (count > 1), "sequence/parent: -1 if and only if the row has one object")
    require((parent >= -1) & (parent < number), "sequence/parent: must be an earlier row")
    known = (parent >= 0) & (parent < number)
    inherited = {name: np.ones(len(count), bool) for name in _INHERITED}
    shorter = np.ones(len(count), bool)
    mine = rows.columns()
    for block in np.unique(parent[known] // CHUNK_ROWS):
        start = int(block) * CHUNK_ROWS
        some = np.flatnonzero(known & (parent // CHUNK_ROWS == block))
        for name, good in inherited.items():
            theirs = column(name, start, start + CHUNK_ROWS)[parent[some] - start]
            if name == "object_index":
                shorter[some] = (theirs >= 0).sum(1) == count[some] - 1
            good[some] = _same_steps(mine[name][some], theirs, count[some] - 1)
    require(shorter, "sequence/parent: must have one object less")
    for name, good in inherited.items():
        require(good, f"{name}: earlier steps differ from those of the parent")


def _same_steps(a: np.ndarray, b: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Which rows agree in their first ``steps`` [n] slots, NaN with NaN; both are [n, O, ...]."""
    same = (a == b) | ((a != a) & (b != b))
    beyond = np.arange(a.shape[1]) >= steps[:, None]  # (n, o)
    return (same.reshape(*a.shape[:2], -1).all(2) | beyond).all(1)

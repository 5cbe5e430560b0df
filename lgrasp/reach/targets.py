"""Where the hand of each row is to be, once its object has a place before the arm."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from lgrasp.errors import ShardError
from lgrasp.geometry.poses import compose, inverse, pose_matrix, rotated, shortest_rotation
from lgrasp.grasp.approach_kernels import APPROACH_LENGTH
from lgrasp.grasp.records import GraspRows, ObjectRecord
from lgrasp.reach.placement import Placement

CODES = ("reached", "no_posture", "no_way", "hits_table", "hits_itself")
"""What a target lacks, by its code: nothing; a posture of the arm at the pose; postures
all along the way; room above the table; postures without self-collision."""


class Targets(NamedTuple):
    """Poses of the hand's base link in the frame of the arm's root link, N of them."""

    T: np.ndarray
    """Shape [N, 4, 4]."""
    way: np.ndarray | None = None
    """Vector of the straight way to each [m], shape [N, 3]; None: nothing is asked of the way."""
    table: np.ndarray | None = None
    """Unit normal up and height of the table, which links stay above, shape [4]."""


def placed_objects(at: Placement, rows: GraspRows, objects: Sequence[ObjectRecord]) -> np.ndarray:
    """Poses of the objects of rows of one object, as of those in a shard, but in the frame of the arm, shape [N, 7].

    An object on a table stands on the plane z = 0 of the place as its row says: the normal of its plane is turned up
    the shortest way, and the origin of its frame is above the place's.

    Args:
        objects: sorted by id.

    Raises:
        ShardError: a row names a plane that its object does not have.
    """
    place = np.broadcast_to(at.pose, (len(rows), 7))
    if not rows.table:
        return place.copy()
    own = np.zeros((len(rows), 7))
    for number, record in enumerate(objects):
        chosen = np.flatnonzero(rows.object_index[:, 0] == number)
        planes, pose = record.tables, rows.table["pose"][chosen]
        if planes is None or not ((pose >= 0) & (pose < len(planes))).all():
            raise ShardError(f"table/pose names a plane that object '{record.id}' does not have")
        up = planes[pose, :3].astype(float)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        own[chosen, 2] = -planes[pose, 3]
        own[chosen, 3:] = shortest_rotation(up).inv().as_quat(scalar_first=True)
    return compose(place, own)


def hand_targets(at: Placement, rows: GraspRows, placed: np.ndarray) -> Targets:
    """What an arm is to reach: base links of hands with objects that are placed so, shape [N, 7]; on a table also all
    along the straight way to the grasp, with the arm above it."""
    hand = compose(placed, inverse(rows.object_pose[:, 0]))
    T = pose_matrix(hand)
    if not rows.table:
        return Targets(T)
    approach = rows.table["approach"].astype(float)
    up = pose_matrix(at.pose)[:3, 2]
    table = np.append(up, up @ np.array(at.position))
    return Targets(T, APPROACH_LENGTH * rotated(hand[:, 3:], approach), table)

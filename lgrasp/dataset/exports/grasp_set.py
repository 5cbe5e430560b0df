"""The result of the readers of exports: rows as in a shard, with names."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lgrasp.errors import ShardError
from lgrasp.geometry.poses import canonical
from lgrasp.grasp.records import GraspRows


class ReadObject(NamedTuple):
    """An object that grasps of another format name."""

    code: str
    scale: float
    """Factor from the mesh to metres as grasped."""
    mesh: Path | None
    """Its mesh file, where one is known."""


class GraspSet(NamedTuple):
    """Grasps read from another format."""

    joint_names: tuple[str, ...]
    """Joints in the order of q, length K."""
    objects: tuple[ReadObject, ...]
    """What ``object_index`` counts in."""
    grasps: GraspRows
    """Rows without contacts (C = 0) and without metrics; ``candidate`` counts them. Poses of objects are in the base
    link's frame where the folder names one (an export of lgrasp), else in the frame that the format gives poses of."""


def make_set(
    joint_names: Sequence[str],
    objects: Sequence[ReadObject],
    q: np.ndarray,
    object_pose: np.ndarray,
    object_index: np.ndarray,
) -> GraspSet:
    """Rows in the dtypes of a shard.

    Args:
        joint_names: Length K.
        objects: What ``object_index`` counts in.
        q: Joints [rad or m] at the grasp, before closing, and as targets that press, shape [n, 3, K].
        object_pose: In the hand's frame, x y z [m] qw qx qy qz, shape [n, O, 7]; NaN where absent.
        object_index: Shape [n, O]; -1 where absent.
    """
    n, width = object_index.shape
    pose = np.concatenate([object_pose[..., :3], canonical(object_pose[..., 3:])], -1).astype(np.float32)
    nothing = np.zeros((n, width, 0, 3), np.float32)
    rows = GraspRows(
        q=q[:, 0].astype(np.float32),
        q_pregrasp=q[:, 1].astype(np.float32),
        q_squeeze=q[:, 2].astype(np.float32),
        object_pose=pose,
        object_index=object_index.astype(np.int32),
        contact_points=nothing,
        contact_normals=nothing,
        contact_links=np.zeros((n, width, 0), np.int16),
        contact_forces=nothing,
        candidate=np.arange(n, dtype=np.uint64),
    )
    return GraspSet(tuple(joint_names), tuple(objects), rows)


def order_of(names: Sequence[str], wanted: Sequence[str], where: object) -> list[int]:
    """Place in ``names`` of each wanted joint.

    Raises:
        ShardError: The two do not name the same joints.
    """
    if sorted(names) != sorted(wanted):
        lacking = sorted(set(wanted) - set(names))
        other = f"lacks joint {lacking[0]!r}" if lacking else f"has joint {sorted(set(names) - set(wanted))[0]!r}"
        raise ShardError(f"{where}: {other}; expected {', '.join(wanted)}")
    return [list(names).index(name) for name in wanted]

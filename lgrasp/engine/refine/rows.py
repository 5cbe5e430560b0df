"""Grasps of one object as the rows of a shard."""

from collections.abc import Mapping

import numpy as np

from lgrasp.dataset import GraspRows
from lgrasp.engine.generate import METRIC_UNITS
from lgrasp.grasp.tables import GraspTable, user_poses
from lgrasp.hand.model import HandModel
from lgrasp.object.model import ObjectModel

__all__ = ["shard_rows"]


def shard_rows(
    table: GraspTable, hand: HandModel, obj: ObjectModel, extra: Mapping[str, np.ndarray] | None = None
) -> GraspRows:
    """Rows in the user's frame of the object; ``extra`` are further metrics, (N,) each."""
    tree, center = hand.tree, obj.center
    filled = table.contact_links >= 0
    return GraspRows(
        q=tree.listed_values(table.q),
        q_pregrasp=tree.listed_values(table.q_pregrasp),
        q_squeeze=tree.listed_values(table.q_squeeze),
        object_pose=user_poses(table.pose, center)[:, None],
        object_index=np.zeros((len(table), 1), np.int32),
        contact_points=(table.contact_points + center)[:, None],
        contact_normals=table.contact_normals[:, None],
        contact_links=table.contact_links[:, None].astype(np.int16),
        contact_forces=_scaled(table)[:, None],
        candidate=table.index.astype(np.uint64),
        metrics={**table.metrics, "contacts": filled.sum(1).astype(np.float32), **(extra or {})},
        metric_units=METRIC_UNITS,
    )


def _scaled(table: GraspTable) -> np.ndarray:
    """Contact forces whose normal parts sum to exactly 1, where there are any."""
    normal = -(table.contact_forces * table.contact_normals).sum(-1)
    total = np.nansum(normal, 1)
    return table.contact_forces / np.where(total > 1e-6, total, 1.0)[:, None, None]

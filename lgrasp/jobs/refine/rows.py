"""Grasps of one object as the rows of a shard."""

from collections.abc import Mapping

import numpy as np

from lgrasp.dataset import GraspRows
from lgrasp.grasp.tables import GraspTable, user_poses
from lgrasp.hand.model import HandModel
from lgrasp.jobs.generate import METRIC_UNITS
from lgrasp.object.model import ObjectModel

_LEAST = 1e-3  # of the normal forces together, which are 1


def shard_rows(
    table: GraspTable, hand: HandModel, obj: ObjectModel, extra: Mapping[str, np.ndarray] | None = None
) -> GraspRows:
    """Rows in the user's frame of the object; ``extra`` are further metrics, (N,) each."""
    tree, center = hand.tree, obj.center
    normal = -np.nansum(table.contact_forces * table.contact_normals, axis=(1, 2))
    # a single contact carries no force: a row has contacts that press against each other, or none
    filled = (table.contact_links >= 0) & (normal > _LEAST)[:, None]
    forces = table.contact_forces / np.maximum(normal, _LEAST)[:, None, None]

    def contacts(values: np.ndarray) -> np.ndarray:
        return np.where(filled[..., None], values, np.nan).astype(np.float32)[:, None]

    return GraspRows(
        q=tree.listed_values(table.q),
        q_pregrasp=tree.listed_values(table.q_pregrasp),
        q_squeeze=tree.listed_values(table.q_squeeze),
        object_pose=user_poses(table.pose, center)[:, None],
        object_index=np.zeros((len(table), 1), np.int32),
        contact_points=contacts(table.contact_points + center),
        contact_normals=contacts(table.contact_normals),
        contact_links=np.where(filled, table.contact_links, -1)[:, None].astype(np.int16),
        contact_forces=contacts(forces),
        candidate=table.index.astype(np.uint64),
        metrics={**table.metrics, "contacts": filled.sum(1).astype(np.float32), **(extra or {})},
        metric_units=METRIC_UNITS,
    )

"""Sequences as the rows of a shard: poses and contacts go from internal frames to the user's."""

import numpy as np

from lgrasp.dataset import GraspRows
from lgrasp.grasp.records import ObjectRecord, SequenceRows
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.grasp.tables import user_poses
from lgrasp.jobs.generate import METRIC_UNITS
from lgrasp.jobs.records import object_record
from lgrasp.jobs.sequence.inputs import SequenceInputs

_ROUND_BITS, _SHARD_BITS = np.uint64(24), np.uint64(40)


def object_records(inputs: SequenceInputs) -> list[ObjectRecord]:
    """The objects, each once, sorted by id."""
    found = dict(zip(inputs.object_ids, inputs.objects, strict=True))
    return [object_record(found[name].model, name) for name in sorted(found)]


def sequence_rows(
    levels: list[SequenceTable], inputs: SequenceInputs, shard: int, protocol: str = "", *, objects: int = 0
) -> GraspRows:
    """Rows of all levels, shorter ones first.

    Args:
        levels: rows of ever more objects; parents are rows of the level before.
        protocol: of the verdicts, if there are any.
        objects: slots of a row; 0: as many as there are levels.
    """
    slots = objects or len(levels)
    first = np.cumsum([0, *map(len, levels)])
    whole = [_level(table, inputs, slots) for table in levels]
    columns = {name: np.concatenate([level[name] for level in whole]) for name in whole[0]}
    steps = np.repeat([table.steps for table in levels], np.diff(first))
    parent = np.concatenate([table.parent + before for table, before in zip(levels, [0, *first], strict=False)])
    last = np.arange(len(steps)), steps - 1
    metrics = {name: np.concatenate([t.metrics[name] for t in levels]) for name in levels[0].metrics}
    physics = {name: np.concatenate([t.physics[name] for t in levels]) for name in levels[0].physics}
    candidate = np.concatenate([table.candidate for table in levels]).astype(np.uint64)
    links = columns["contact_links"]
    width = max(1, int((links >= 0).sum(2).max(initial=1)))
    return GraspRows(
        q=columns["q"][last],
        q_pregrasp=columns["q_pregrasp"][last],
        q_squeeze=columns["q_squeeze"][last],
        object_pose=columns["object_pose"],
        object_index=columns["object_index"],
        contact_points=columns["contact_points"][:, :, :width],
        contact_normals=columns["contact_normals"][:, :, :width],
        contact_links=links[:, :, :width],
        contact_forces=columns["contact_forces"][:, :, :width],
        candidate=(np.uint64(shard) << _SHARD_BITS) + candidate,
        metrics=metrics | {"contacts": (links >= 0).sum((1, 2)).astype(np.float32)},
        metric_units=METRIC_UNITS,
        physics=physics,
        physics_protocols=dict.fromkeys(physics, protocol),
        sequence=SequenceRows(
            space_names=[space.name for space in inputs.spaces],
            space=columns["space"],
            free_joints=columns["free_joints"],
            parent=np.where(steps > 1, parent, -1),
            q=columns["q"],
            q_pregrasp=columns["q_pregrasp"],
            q_squeeze=columns["q_squeeze"],
        ),
    )


def _level(table: SequenceTable, inputs: SequenceInputs, slots: int) -> dict[str, np.ndarray]:
    """Columns of rows of equally many objects, absent slots filled."""
    tree, n = inputs.hand.tree, table.steps
    centers = np.array([obj.model.center for obj in inputs.objects[:n]])
    ids = inputs.object_ids
    number = np.array([sorted(set(ids)).index(name) for name in ids[:n]], np.int32)
    poses = [user_poses(table.pose[:, s], centers[s]) for s in range(n)]

    def listed(values: np.ndarray) -> np.ndarray:
        return np.stack([tree.listed_values(values[:, s]) for s in range(n)], 1)

    held = np.zeros((len(table), n, len(tree.locked_names)), bool)
    columns = {
        "q": (listed(table.q), np.nan),
        "q_pregrasp": (listed(table.q_pregrasp), np.nan),
        "q_squeeze": (listed(table.q_squeeze), np.nan),
        "object_pose": (np.stack(poses, 1), np.nan),
        "object_index": (np.broadcast_to(number, (len(table), n)), -1),
        "contact_points": (table.contact_points + centers[:, None].astype(np.float32), np.nan),
        "contact_normals": (table.contact_normals, np.nan),
        "contact_links": (table.contact_links.astype(np.int16), -1),
        "contact_forces": (table.contact_forces, np.nan),
        "space": (table.space.astype(np.int16), -1),
        "free_joints": (np.concatenate([table.free, held, table.free[:, :, tree.coupled_column]], 2), False),
    }
    return {name: _padded(values, slots, fill) for name, (values, fill) in columns.items()}


def _padded(values: np.ndarray, slots: int, fill: float) -> np.ndarray:
    """(N, slots, ...) with the absent slots at the end filled."""
    out = np.full((len(values), slots, *values.shape[2:]), fill, values.dtype)
    out[:, : values.shape[1]] = values
    return out

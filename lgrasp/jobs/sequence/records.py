"""Sequences as the rows of a shard: poses and contacts go from internal frames to the user's."""

from typing import Any

import numpy as np

from lgrasp.grasp.records import GraspRows, ObjectRecord, SequenceRows, padded
from lgrasp.grasp.rows import METRIC_UNITS, row_numbers, step_columns, used_width
from lgrasp.grasp.schema import POSTURES
from lgrasp.grasp.sequences import SequenceTable
from lgrasp.grasp.tables import CONTACTS
from lgrasp.jobs.records import object_record
from lgrasp.jobs.sequence.inputs import SequenceInputs


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
    candidate = np.concatenate([table.candidate for table in levels])
    links = columns["contact_links"]
    width = used_width(links)
    shared: dict[str, Any] = {name: columns[name][last] for name in POSTURES}
    shared |= {name: columns[name][:, :, :width] for name in CONTACTS}
    return GraspRows(
        **shared,
        object_pose=columns["object_pose"],
        object_index=columns["object_index"],
        candidate=row_numbers(shard, candidate),
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
    ids = inputs.object_ids
    number = np.array([sorted(set(ids)).index(name) for name in ids[:n]], np.int32)
    postures, contacts = ({name: getattr(table, name) for name in names} for names in (POSTURES, CONTACTS))
    centers = np.array([obj.model.center for obj in inputs.objects[:n]])
    held = np.zeros((len(table), n, len(tree.locked_names)), bool)
    columns = step_columns(tree, postures, table.pose, contacts, centers) | {
        "object_index": np.broadcast_to(number, (len(table), n)),
        "space": table.space.astype(np.int16),
        "free_joints": np.concatenate([table.free, held, table.free[:, :, tree.coupled_column]], 2),
    }
    return {name: padded(values, (slots, *values.shape[2:])) for name, values in columns.items()}

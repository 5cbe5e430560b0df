"""Reads shards once and keeps the counts and the sample that the report needs, not rows."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.report.coverage import Coverage
from lgrasp.dataset.report.held import HeldRows, add_held
from lgrasp.dataset.report.near import NearRows
from lgrasp.dataset.report.physics import Verdicts, add_verdicts
from lgrasp.dataset.report.quantity import QUANTITIES, Distribution
from lgrasp.dataset.report.sample import EvenSample
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord

BLOCK_ROWS = 16_384
_SAMPLE_ROWS = 50_000


@dataclass
class ObjectRows:
    """Rows of one hand with one object, or one set of objects at once."""

    names: tuple[str, ...]
    rows: int = 0
    quantities: dict[str, Distribution] = field(default_factory=lambda: {q.name: Distribution(q) for q in QUANTITIES})
    contacts: Counter[int] = field(default_factory=Counter)
    """Rows by number of contacts."""
    near: NearRows = field(default_factory=NearRows)
    coverage: dict[str, Coverage] = field(default_factory=dict)
    """By object."""
    verdicts: dict[str, Verdicts] = field(default_factory=dict)
    """By protocol."""


class HandRows:
    """All rows of one hand.

    Args:
        hand: From one of its shards.
    """

    def __init__(self, hand: HandRecord) -> None:
        k = len(hand.joint_names)
        self.hand = hand
        self.rows = 0
        self.links = np.zeros(len(hand.link_names), np.int64)
        """Contacts of each link."""
        self.sum_q, self.sum_qq = np.zeros(k), np.zeros((k, k))
        self.objects: dict[tuple[str, ...], ObjectRows] = {}
        self.held: dict[int, HeldRows] = {}
        """By the number of objects in the hand."""
        self.sample = EvenSample(_SAMPLE_ROWS)
        """q [K], position of the (first) object's middle in the hand's frame [3], place of its group in ``objects``."""

    def add(self, reader: ShardReader, labels: list[str], advanced: Callable[[int], None]) -> None:
        """Take all rows of a shard.

        Args:
            reader: The shard.
            labels: What to call its objects, in the order of ``object_index``.
            advanced: Called with the number of rows taken so far.

        Raises:
            ShardError: The file is damaged.
        """
        records = reader.objects()
        for start in range(0, len(reader), BLOCK_ROWS):
            rows = reader.rows(start, start + BLOCK_ROWS)
            self._add_postures(rows)
            add_held(self.held, rows)
            for index in np.unique(rows.object_index, axis=0):
                chosen = np.flatnonzero((rows.object_index == index).all(1))
                self._add_rows(_take(rows, chosen), index, records, labels)
            advanced(start + len(rows))

    def together(self) -> dict[str, Distribution]:
        """Distributions over all objects."""
        whole = {q.name: Distribution(q) for q in QUANTITIES}
        for group in self.objects.values():
            for name, distribution in group.quantities.items():
                whole[name].merge(distribution)
        return whole

    def directions(self) -> dict[str, np.ndarray]:
        """Rows per bin of the approach direction, by object, whatever else the hand holds."""
        counts: dict[str, np.ndarray] = {}
        for group in self.objects.values():
            for name, coverage in group.coverage.items():
                counts[name] = counts.get(name, 0) + coverage.directions
        return counts

    def close(self) -> None:
        """Let go of what only further rows of the objects so far would need."""
        for group in self.objects.values():
            group.near.close()

    def _add_postures(self, rows: GraspRows) -> None:
        q = rows.q.astype(float)
        self.rows += len(q)
        self.sum_q += q.sum(0)
        self.sum_qq += q.T @ q
        links = rows.contact_links
        self.links += np.bincount(links[links >= 0], minlength=len(self.links))

    def _add_rows(
        self, rows: GraspRows, index: np.ndarray, records: tuple[ObjectRecord, ...], labels: list[str]
    ) -> None:
        """Rows that hold the same objects in the same order, ``index`` [O]."""
        present = np.flatnonzero(index >= 0)
        names = tuple(labels[index[o]] for o in present)
        group = self.objects.setdefault(names, ObjectRows(names))
        group.rows += len(rows)
        for name, distribution in group.quantities.items():
            if name in rows.metrics:
                distribution.add(rows.metrics[name])
            else:
                distribution.missing += len(rows)
        group.contacts.update((rows.contact_links >= 0).sum((1, 2)).tolist())
        group.near.add(rows.object_pose[:, present], rows.q)
        middles = []
        for o, name in zip(present, names, strict=True):
            vertices = np.asarray(records[index[o]].vertices, float)
            middle = (vertices.min(0) + vertices.max(0)) / 2
            T = pose_matrix(rows.object_pose[:, o].astype(float))
            middles.append(group.coverage.setdefault(name, Coverage()).add(T, middle))
        add_verdicts(group.verdicts, rows.physics, rows.physics_protocols)
        place = list(self.objects).index(names)
        self.sample.add({"q": rows.q, "position": middles[0].astype(np.float32), "group": np.full(len(rows), place)})


def _take(rows: GraspRows, chosen: np.ndarray) -> GraspRows:
    """Some of the rows, by index [n]."""
    if len(chosen) == len(rows):
        return rows
    values: dict[str, Any] = {name: column[chosen] for name, column in rows.columns().items() if "/" not in name}
    for group in ("metrics", "physics"):
        values[group] = {name: column[chosen] for name, column in getattr(rows, group).items()}
    return GraspRows(**values, metric_units=rows.metric_units, physics_protocols=rows.physics_protocols)

"""Reads shards once and keeps the counts and the sample that the report needs, not rows."""

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import reduce

import numpy as np

from lgrasp.dataset.checks import refuse_not_finite
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.report.diversity import Coverage, GraspSpread, TouchedSurface
from lgrasp.dataset.report.quantity import QUANTITIES, Distribution
from lgrasp.dataset.report.verdicts import HeldRows, Verdicts, add_held, add_verdicts
from lgrasp.geometry.poses import pose_matrix
from lgrasp.grasp.bounds import measured_strictly
from lgrasp.grasp.duplicates import KeptRows, near_pairs
from lgrasp.grasp.records import GraspRows, HandRecord, ObjectRecord

_MAX_ROWS = 2_000_000  # rows held for comparison
_BLOCK_ROWS = 16_384
_SAMPLE_ROWS = 50_000
_HASH_START, _HASH_PRIME = np.uint64(0xCBF29CE484222325), np.uint64(0x100000001B3)


class NearRows:
    """Rows that are near-duplicates of a row before them, found on a device of Warp.

    With one object every row is compared with all rows kept so far, up to two million. With several, all of which must
    be near, it is compared within the rows of one call.

    Args:
        device: None: poses are counted, and nothing is compared.
    """

    def __init__(self, device: str | None) -> None:
        self.compared = self.duplicates = 0
        self._device = device
        self._kept: KeptRows | None = None
        self._poses = DistinctRows()

    @property
    def poses(self) -> int:
        """Poses so far, each counted once."""
        return len(self._poses)

    def add(self, pose: np.ndarray, q: np.ndarray) -> None:
        """Compare further rows: object poses [n, o, 7], of the same objects in every row, and joints [n, K]."""
        if not len(pose):
            return
        self._poses.add(pose.reshape(len(pose), -1))
        if self._device is None:
            return
        if pose.shape[1] > 1:
            self._compare_sets(pose, q, self._device)
            return
        self._kept = self._kept or KeptRows(q.shape[1], self._device)
        room = _MAX_ROWS - self._kept.count
        if room > 0:
            kept, near = self._kept.add(pose[:, 0], q, room)
            self.compared += len(kept) + near
            self.duplicates += near

    def close(self) -> None:
        """Forget the rows, keep the counts."""
        self._kept = None

    def _compare_sets(self, pose: np.ndarray, q: np.ndarray, device: str) -> None:
        n = len(q)
        near = [i * n + j for i, j in (near_pairs(pose[:, o], q, device).T for o in range(pose.shape[1]))]
        drop = np.zeros(n, bool)
        for i, j in np.stack(np.divmod(reduce(np.intersect1d, near), n), 1):  # by the earlier row, so it is decided
            drop[j] |= not drop[i]
        self.compared += n
        self.duplicates += int(drop.sum())


class DistinctRows:
    """How many different rows there are in a stream, by 64-bit hashes, of which each different one is held."""

    def __init__(self) -> None:
        self._known = np.zeros(0, np.uint64)
        self._new: list[np.ndarray] = []

    def add(self, rows: np.ndarray) -> None:
        """Take further rows, [n, k] of one kind of number with 4 or 8 bytes."""
        words = np.ascontiguousarray(rows).view(np.uint32).astype(np.uint64)
        hashes = np.full(len(words), _HASH_START, np.uint64)
        for column in words.T:
            hashes = (hashes ^ column) * _HASH_PRIME
            hashes ^= hashes >> np.uint64(32)
        self._new.append(np.unique(hashes))
        if sum(map(len, self._new)) > max(len(self._known), _BLOCK_ROWS):
            self._merge()

    def __len__(self) -> int:
        self._merge()
        return len(self._known)

    def _merge(self) -> None:
        if self._new:
            self._known, self._new = np.unique(np.concatenate([self._known, *self._new])), []


class EvenSample:
    """Every k-th row of a stream, however it is cut; k doubles whenever more than ``limit`` rows are held."""

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.step = 1
        """Every how many-th row is held."""
        self._seen = 0
        self._parts: list[dict[str, np.ndarray]] = []

    def add(self, columns: dict[str, np.ndarray]) -> None:
        """Take rows: arrays with one first axis, the same names at every call."""
        n = len(next(iter(columns.values())))
        first = -self._seen % self.step
        self._seen += n
        if first < n:
            self._parts.append({name: values[first :: self.step] for name, values in columns.items()})
        while sum(len(next(iter(part.values()))) for part in self._parts) > self.limit:
            self._parts = [{name: values[::2] for name, values in self.columns().items()}]
            self.step *= 2

    def columns(self) -> dict[str, np.ndarray]:
        """The rows held; empty if there were none."""
        names = self._parts[0] if self._parts else ()
        return {name: np.concatenate([part[name] for part in self._parts]) for name in names}


@dataclass
class ObjectRows:
    """Rows of one hand with one object, or one set of objects at once."""

    names: tuple[str, ...]
    near: NearRows
    rows: int = 0
    quantities: dict[str, Distribution] = field(default_factory=lambda: {q.name: Distribution(q) for q in QUANTITIES})
    contacts: Counter[int] = field(default_factory=Counter)
    """Rows by number of contacts."""
    coverage: dict[str, Coverage] = field(default_factory=dict)
    """By object."""
    touched: dict[str, TouchedSurface] = field(default_factory=dict)
    """By object."""
    spread: dict[str, GraspSpread] = field(default_factory=dict)
    """By object."""
    verdicts: dict[str, Verdicts] = field(default_factory=dict)
    """By protocol."""


class HandRows:
    """All rows of one hand; near-duplicates are looked for on a device of Warp, if one is named."""

    def __init__(self, hand: HandRecord, device: str | None, locked: Collection[str] = ()) -> None:
        k = len(hand.joint_names)
        self.hand = hand
        self.locked = locked
        self.rows = 0
        self.links = np.zeros(len(hand.link_names), np.int64)
        """Contacts of each link."""
        self.sum_q, self.sum_qq = np.zeros(k), np.zeros((k, k))
        self.objects: dict[tuple[str, ...], ObjectRows] = {}
        self.held: dict[int, HeldRows] = {}
        """By the number of objects in the hand."""
        self.sample = EvenSample(_SAMPLE_ROWS)
        """q [K], place of its group in ``objects``."""
        self.middles = EvenSample(_SAMPLE_ROWS)
        """Of objects in rows: position of its middle in the hand's frame [3], place of its name in ``names``."""
        self._device = device

    def add(self, reader: ShardReader, labels: list[str], advanced: Callable[[int], None]) -> None:
        """Take all rows of a shard, calling ``advanced`` with the number of rows taken so far.

        Args:
            labels: What to call its objects, in the order of ``object_index``.

        Raises:
            ShardError: The file is damaged.
        """
        records, strict = reader.objects(), measured_strictly(reader.header.config)
        for start in range(0, len(reader), _BLOCK_ROWS):
            rows = reader.rows(start, start + _BLOCK_ROWS)
            refuse_not_finite(reader.path, rows.object_index, rows.object_pose, {"q": rows.q}, start)
            q, links = rows.q.astype(float), rows.contact_links
            self.rows += len(q)
            self.sum_q += q.sum(0)
            self.sum_qq += q.T @ q
            self.links += np.bincount(links[links >= 0], minlength=len(self.links))
            add_held(self.held, rows)
            for index in np.unique(rows.object_index, axis=0):
                chosen = np.flatnonzero((rows.object_index == index).all(1))
                held = [(slot, labels[k], records[k]) for slot, k in enumerate(index) if k >= 0]
                self._add_rows(rows, chosen, held, strict)
            advanced(start + len(rows))

    @property
    def names(self) -> list[str]:
        """Of all objects."""
        return list(dict.fromkeys(name for group in self.objects for name in group))

    def together(self) -> dict[str, Distribution]:
        """Distributions over all objects."""
        whole = {q.name: Distribution(q) for q in QUANTITIES}
        for group in self.objects.values():
            for name, distribution in group.quantities.items():
                whole[name].merge(distribution)
        return whole

    def spread(self) -> GraspSpread:
        """Of the rows with all objects."""
        whole = GraspSpread(self.hand, self.locked)
        for group in self.objects.values():
            for found in group.spread.values():
                whole.merge(found)
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

    def _add_rows(
        self, rows: GraspRows, chosen: np.ndarray, held: list[tuple[int, str, ObjectRecord]], strict: bool
    ) -> None:
        """Some rows, by their numbers, that hold the same objects in the same slots."""
        slots, names = [slot for slot, _, _ in held], tuple(name for _, name, _ in held)
        group = self.objects.setdefault(names, ObjectRows(names, NearRows(self._device)))
        group.rows += len(chosen)
        for name, distribution in group.quantities.items():
            if name in rows.metrics:
                distribution.add(rows.metrics[name][chosen], strict=strict)
            else:
                distribution.missing += len(chosen)
        group.contacts.update((rows.contact_links[chosen] >= 0).sum((1, 2)).tolist())
        q, pose = rows.q[chosen], rows.object_pose[chosen]
        group.near.add(pose[:, slots], q)
        for o, name, record in held:
            vertices = np.asarray(record.vertices, float)
            middle = (vertices.min(0) + vertices.max(0)) / 2
            T = pose_matrix(pose[:, o].astype(float))
            position = group.coverage.setdefault(name, Coverage()).add(T, middle).astype(np.float32)
            self.middles.add({"position": position, "name": np.full(len(chosen), self.names.index(name))})
            group.spread.setdefault(name, GraspSpread(self.hand, self.locked)).add(T, q.astype(float))
            if name not in group.touched:
                group.touched[name] = TouchedSurface(record)
            contacts = (rows.contact_points[chosen, o], rows.contact_normals[chosen, o])
            group.touched[name].add(*(values.reshape(-1, 3) for values in contacts))
        add_verdicts(group.verdicts, rows, chosen)
        place = np.full(len(chosen), list(self.objects).index(names))
        self.sample.add({"q": q, "group": place})

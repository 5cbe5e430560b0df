"""The contents of an export: which rows of which shards, chosen by conditions, in which order, of which objects."""

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from lgrasp.dataset.checks import refuse_not_finite
from lgrasp.dataset.conditions import ALL, OBJECTS_HELD, Condition, satisfied_or_invalid
from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.split import Split
from lgrasp.errors import ShardError
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.grasp.schema import CHUNK_ROWS, POSTURES
from lgrasp.paths import free_name
from lgrasp.words import plural

_NUMBER = re.compile("metrics/|physics/|candidate$")
_VERDICT = re.compile("physics/.+_holds$|metrics/valid$")


class ExportObject(NamedTuple):
    """An object of an export."""

    code: str
    """Name in the export, fit for a file name, unique."""
    record: ObjectRecord
    """As in the shard, without vertices and faces (both empty)."""
    shard: Path
    """A shard that holds the mesh."""

    def mesh(self) -> ObjectRecord:
        """The record with its mesh."""
        with ShardReader(self.shard) as reader:
            return reader.object(self.record.id)


class Batch(NamedTuple):
    """Some rows; ``n`` rows, ``K`` joints, ``O`` objects in a row (1 if the selection is of single objects)."""

    number: np.ndarray
    """Running number of each row in the export, shape [n]."""
    q: np.ndarray
    """Joint positions [rad or m] in the order of the selection's hand, float64, shape [n, K]."""
    q_pregrasp: np.ndarray
    q_squeeze: np.ndarray
    object_pose: np.ndarray
    """Object in the hand base frame, x y z [m] qw qx qy qz, float64, shape [n, O, 7]; NaN where absent."""
    object_index: np.ndarray
    """Position in the selection's objects, shape [n, O]; -1 where absent."""
    holds: np.ndarray
    """0 where a simulator saw the grasp fail, or a row fails a bound (metric ``valid``), else 1; shape [n]."""
    table: Mapping[str, np.ndarray]
    """Of grasps of an object on a table, else empty; by the names that are written: ``table_plane``, unit normal up and
    height along it [m], shape [n, 4], and ``table_approach``, unit direction in which the open hand comes, shape
    [n, 3]; object's frame, float64."""
    numbers: Mapping[str, np.ndarray]
    """Of a selection's ``numbers`` by name, if they were asked for; each shape [n]."""

    def tables(self) -> list[dict[str, list[float]]]:
        """``table`` row by row, length n."""
        return [{name: values[row].tolist() for name, values in self.table.items()} for row in range(len(self.q))]

    @property
    def postures(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Joints at the grasp, before closing, and as targets that press."""
        return self.q, self.q_pregrasp, self.q_squeeze


class _Source(NamedTuple):
    path: Path
    rows: np.ndarray  # chosen, ascending
    index: np.ndarray  # (n, O) of the chosen rows, in the selection's objects
    columns: list[int]  # column of q for each joint of the selection
    first: int  # running number of the first chosen row
    planes: list[np.ndarray | None]  # that each of the shard's objects rests on
    on_table: bool
    part: np.ndarray  # (n,) of the chosen rows, in the selection's parts


@dataclass(frozen=True)
class Selection:
    """Rows to export, all of one hand."""

    hand: HandRecord
    objects: tuple[ExportObject, ...]
    """Those that a chosen row holds, by code."""
    counts: tuple[int, ...]
    """How often each object is held."""
    rows: int
    single: bool
    """True if every row holds exactly one object."""
    parts: tuple[str, ...]
    """Names of the parts of the split; one, ``train``, without a split."""
    numbers: tuple[str, ...]
    """Flat names of the metrics and verdicts with one number per row that all shards have, and ``candidate``."""
    negatives: int
    """Rows that satisfy the conditions, and were left out as metric ``valid`` is 0 and no condition names it."""
    _sources: tuple[_Source, ...]

    @property
    def on_table(self) -> bool:
        """True if rows are of objects on a table."""
        return any(source.on_table for source in self._sources)

    @property
    def shards(self) -> list[Path]:
        """The shards that rows are taken from."""
        return [source.path for source in self._sources]

    @property
    def sources(self) -> list[tuple[Path, int]]:
        """The shards, each with how many rows are taken from it."""
        return [(source.path, len(source.rows)) for source in self._sources]

    def batches(
        self,
        holding: int | None = None,
        advance: Callable[[int], None] | None = None,
        *,
        part: int | None = None,
        numbers: bool = False,
    ) -> Iterator[Batch]:
        """The rows in order, at most 4096 at a time, or only those with one of the objects, or of one of the parts;
        ``advance`` is called with the number of rows of each batch when the caller is done with it.

        Raises:
            ShardError: A shard is damaged.
        """
        names = self.numbers if numbers else ()
        for source in self._sources:
            chosen = np.arange(len(source.rows))
            if holding is not None:
                chosen = chosen[(source.index == holding).any(1)]
            if part is not None:
                chosen = chosen[source.part[chosen] == part]
            if not len(chosen):
                continue
            with ShardReader(source.path) as reader:
                for block in np.unique(source.rows[chosen] // CHUNK_ROWS):
                    some = chosen[source.rows[chosen] // CHUNK_ROWS == block]
                    yield self._read(reader, source, some, int(block) * CHUNK_ROWS, names)
                    if advance:
                        advance(len(some))

    def _read(self, reader: ShardReader, source: _Source, some: np.ndarray, start: int, names: Sequence[str]) -> Batch:
        def whole(name: str) -> np.ndarray:
            return reader.column(name, start, start + CHUNK_ROWS)

        def stored(name: str) -> np.ndarray:
            return (chunk[name] if name in chunk else whole(name))[source.rows[some] - start]

        def read(name: str) -> np.ndarray:
            return stored(name).astype(np.float64)

        chunk = {name: whole(name) for name in ("object_index", "object_pose", *POSTURES)}
        joints = {name: chunk[name] for name in POSTURES}
        refuse_not_finite(source.path, chunk["object_index"], chunk["object_pose"], joints, start)
        pose, index = read("object_pose"), source.index[some]
        if self.single:
            present = np.argmax(index >= 0, axis=1)[:, None]
            pose = np.take_along_axis(pose, present[..., None], 1)
            index = np.take_along_axis(index, present, 1)
        holds = np.ones(len(some))
        for name in verdict_columns(reader):
            holds *= read(name) > 0
        q, before, squeeze = (read(name)[:, source.columns] for name in POSTURES)
        table = {}
        if source.on_table:  # such rows hold one object
            planes = zip(read("object_index")[:, 0], read("table/pose"), strict=True)
            table["table_plane"] = np.array([_plane(source, int(item), int(plane)) for item, plane in planes])
            turned = Rotation.from_quat(pose[:, 0, 3:], scalar_first=True)
            table["table_approach"] = turned.inv().apply(read("table/approach"))
        numbers = {name: stored(name) for name in names}
        return Batch(source.first + some, q, before, squeeze, pose, index, holds, table, numbers)


def select_rows(
    paths: Paths,
    *,
    where: Sequence[Condition] = (),
    limit: int | None = None,
    single: bool = False,
    split: Split | None = None,
) -> Selection:
    """Choose rows; reads only the columns of the conditions.

    Args:
        paths: Shard files, or folders of any depth; in these, shards that cannot be taken are left out with a notice.
        where: Conditions that a row must satisfy, all of them.
        limit: Most rows, counted over all shards in the order given.

    Raises:
        ShardError: A shard cannot be read, holds what is in no part, hands differ, no row is left, or a row holds
            several objects and ``single``.
    """
    hand: HandRecord | None = None
    source: Path | None = None
    known: dict[tuple[str, str, float], ExportObject] = {}
    sources: list[_Source] = []
    numbers: dict[str, None] | None = None
    chosen = seen = negatives = 0

    def look(reader: ShardReader) -> tuple[np.ndarray, np.ndarray, np.ndarray, int, int]:
        """The rows that conditions leave, their ``object_index`` and parts; how many there are, and are negatives."""
        reader.check_whole()
        rows, index, failing = chosen_rows(reader, where, single=single)
        parts = np.zeros(len(reader), int) if split is None else split.numbers(reader)
        return rows, index, parts[rows], len(reader), failing

    for path, _, (rows, index, part, number, failing) in gather(paths, look):
        with ShardReader(path) as reader:
            this = reader.hand()
            hand, source = hand or this, source or path
            if this.sha256 != hand.sha256 or sorted(this.joint_names) != sorted(hand.joint_names):
                raise ShardError(
                    f"{path}: another hand ({this.name}) than {source} ({hand.name}); export one at a time"
                )
            columns = [list(this.joint_names).index(name) for name in hand.joint_names]
            records, on_table = reader.objects(), "table/pose" in reader.columns
            places = np.array([*(_place(record, path, known) for record in records), -1])  # -1: absent
            own = number_columns(reader)
        rows = rows[: None if limit is None else limit - chosen]
        index, part = index[: len(rows)], part[: len(rows)]
        seen += number
        negatives += failing
        planes = [record.tables for record in records]
        sources.append(_Source(path, rows, places[index], columns, chosen, planes, on_table, part))
        if len(rows):
            numbers = dict.fromkeys(name for name in own if numbers is None or name in numbers)
        chosen += len(rows)
        if chosen == limit:
            break
    assert hand is not None
    if not chosen:
        if negatives:
            raise ShardError(f"{source}: no rows to export; metric valid is 0 of all: --where '{ALL}' takes them")
        why = f"none satisfies {' and '.join(map(str, where))}" if where and seen else "there are none"
        of = f"{plural(len(sources), 'shard')}, {seen:,} rows"
        raise ShardError(f"{source}: no rows to export; {why} ({of})")
    objects = list(known.values())
    counts = np.bincount(np.concatenate([s.index[s.index >= 0] for s in sources]), minlength=len(objects))
    order = sorted(np.flatnonzero(counts), key=lambda i: objects[i].code)
    place = np.full(len(objects) + 1, -1)
    place[order] = np.arange(len(order))
    return Selection(
        hand=hand,
        objects=tuple(objects[i] for i in order),
        counts=tuple(int(counts[i]) for i in order),
        rows=chosen,
        single=single,
        parts=("train",) if split is None else tuple(split.parts),
        numbers=tuple(numbers or ()),
        negatives=negatives,
        _sources=tuple(s._replace(index=place[s.index]) for s in sources if len(s.rows)),
    )


def chosen_rows(
    reader: ShardReader, where: Sequence[Condition], *, single: bool = False
) -> tuple[np.ndarray, np.ndarray, int]:
    """The rows of a shard that conditions leave, their ``object_index``, and how many more only metric ``valid`` leaves
    out.

    Raises:
        ShardError: As of :func:`select_rows`.
    """
    good, failing = satisfied_or_invalid(reader, where)
    rows = np.flatnonzero(good)
    index = reader.column("object_index")[rows]
    several = np.flatnonzero((index >= 0).sum(1) != 1)
    if single and len(several):
        count = int((index[several[0]] >= 0).sum())
        hint = f"choose rows with --where '{OBJECTS_HELD} == 1', or --to mjcf"
        raise ShardError(f"{reader.path}: row {rows[several[0]]} holds {count} objects, this format one; {hint}")
    return rows, index, int(failing.sum())


def number_columns(reader: ShardReader) -> list[str]:
    """Columns that tell of a row in one number: metrics, verdicts, and ``candidate``."""
    return [name for name, (shape, _) in reader.columns.items() if len(shape) == 1 and _NUMBER.match(name)]


def verdict_columns(reader: ShardReader) -> list[str]:
    """Columns whose zeros tell that a row failed: in a simulator, by whatever protocol, or a bound."""
    return [name for name in reader.columns if _VERDICT.match(name)]


def _plane(source: _Source, item: int, plane: int) -> np.ndarray:
    """Normal and height of a plane that an object of a shard rests on, (4,)."""
    planes = source.planes[item]
    if planes is None or plane >= len(planes):
        raise ShardError(f"{source.path}: table/pose {plane}: its object has no such plane")
    return planes[plane, :4]


def _place(record: ObjectRecord, path: Path, known: dict[tuple[str, str, float], ExportObject]) -> int:
    """Position in ``known`` of an object of a shard, which is added without its mesh."""
    key = (record.id, record.sha256, record.scale)
    if key not in known:
        nothing = {"vertices": np.zeros((0, 3), np.float32), "faces": np.zeros((0, 3), np.int32), "normals": None}
        safe = re.sub(r"[^A-Za-z0-9_-]+", "_", record.id)[:100].strip("_") or "object"
        code = free_name(safe, "", {o.code for o in known.values()})
        known[key] = ExportObject(code, replace(record, **nothing), path)
    return list(known).index(key)

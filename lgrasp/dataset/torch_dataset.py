"""Grasps of many shards of one hand as tensors: what the data sets of PyTorch share, and a map-style one."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch

from lgrasp.choices import GroupName
from lgrasp.dataset.differences import tell_differences
from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.merge import pad_column, widest
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.split import Split, draw_split, read_groups
from lgrasp.errors import ConfigError, ShardError
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.grasp.schema import CHUNK_ROWS, SEQUENCE_FIELDS


class Source(NamedTuple):
    """A shard."""

    path: Path
    rows: int
    """Those that are read."""
    hand_sha256: str
    objects: list[tuple[str, str, float]]
    """Id, hash and scale."""
    space_names: tuple[str, ...] | None
    columns: dict[str, tuple[tuple[int, ...], np.dtype]]


_OF_VALID = {"metrics/valid": 1.0, "metrics/failed_bound": 0.0}
"""What labels are of a valid row: shards without negatives have none."""


class TorchRows:
    """Rows of shards of one hand; no file stays open.

    Args:
        paths: Shard files, or folders of any depth; what cannot be used in these is left out, with a notice.
        columns: Names to return; by default all that every shard has.
        negatives: Rows with metric ``valid`` 0 too, which fail a bound; :attr:`failed_bounds` names it by the code in
            column ``metrics/failed_bound``.
        split: Only rows of a ``part`` of this split (of :meth:`GraspDataset.split`, or a file of ``lgrasp dataset
            split``); of ``train`` if none is named.

    Raises:
        ShardError: A shard cannot be read, hands differ, or a shard lacks a column.
        ConfigError: The split cannot be read, or has no such part; a part without a split.
    """

    def __init__(
        self,
        paths: Paths,
        columns: Sequence[str] | None,
        negatives: bool,
        split: Split | str | Path | None,
        part: str | None,
    ) -> None:
        if part is not None and split is None:
            raise ConfigError(f"part '{part}' is of no split: give split as well")
        self._negatives, self._part = negatives, part or "train"
        self._split = split if split is None or isinstance(split, Split) else Split.read(split)
        found = [shard.value for shard in gather(paths, self._survey, invalid=negatives)]
        self.failed_bounds: tuple[str, ...] = _failed_bounds(found)
        """Names of the numbers in ``metrics/failed_bound``, if a shard has it."""
        if negatives:
            _label(found)
        self._sources = [source for source in found if source.rows] if self._split else found
        if not self._sources:
            raise ShardError(f"{found[0].path}: no row is in part '{self._part}' of the split ({len(found)} shards)")
        tell_differences(paths)
        first = self._sources[0]
        for source in self._sources:
            if source.hand_sha256 != first.hand_sha256:
                raise ShardError(f"{source.path}: another hand than {first.path}; make one GraspDataset per hand")
        self._ends = list(accumulate(source.rows for source in self._sources))
        self.objects: list[tuple[str, str, float]] = sorted({o for source in self._sources for o in source.objects})
        """Id, SHA-256 of the source mesh and scale of every object."""
        self.space_names: tuple[str, ...] | None = first.space_names
        """Opposition spaces of the hand, if the first shard is of sequences."""
        self.columns: list[str] = self._choose(columns)
        self._tails = {n: widest(source.columns[n][0][1:] for source in self._sources) for n in self.columns}

    def hand(self) -> HandRecord:
        """The hand of all rows."""
        with ShardReader(self._sources[0].path) as reader:
            return reader.hand()

    def object(self, index: int) -> ObjectRecord:
        """The object that ``object_index`` names by ``index``."""
        key = self.objects[index]
        source = next(source for source in self._sources if key in source.objects)
        with ShardReader(source.path) as reader:
            return reader.object(key[0])

    def _choose(self, columns: Sequence[str] | None) -> list[str]:
        kinds = [  # what must agree for a column to be stacked
            {n: (t, len(shape), n in SEQUENCE_FIELDS and s.space_names) for n, (shape, t) in s.columns.items()}
            for s in self._sources
        ]
        common = [name for name, kind in kinds[0].items() if all(other.get(name) == kind for other in kinds)]
        for name in columns or ():
            if name not in common:
                raise ShardError(f"no column {name!r} that all {len(self._sources)} shards have: {', '.join(common)}")
        return common if columns is None else list(columns)

    def _open(self, source: Source) -> ShardReader:
        reader = ShardReader(source.path, invalid=self._negatives)
        if self._split:
            reader.take(self._split.holds(self._part, reader))
        return reader

    def _read(self, shard: int, start: int, stop: int) -> dict[str, torch.Tensor]:
        """Some of the rows of a shard that are read, by column, ``objects`` and parents as counted in all shards."""
        source = self._sources[shard]
        block: dict[str, torch.Tensor] = {}
        with self._open(source) as reader:
            for name in self.columns:
                if name not in reader.columns:  # all rows are valid
                    block[name] = torch.full((stop - start,), _OF_VALID[name])
                    continue
                values = reader.column(name, start, stop)
                if name == "object_index":
                    known = np.array([*(self.objects.index(o) for o in source.objects), -1], dtype=values.dtype)
                    values = known[values]  # -1, absent, takes the last
                elif name == "sequence/parent":
                    values = np.where(values < 0, values, values + self._ends[shard] - source.rows)
                elif name == "candidate":
                    values = values.astype(np.int64)
                block[name] = torch.from_numpy(pad_column(name, values, self._tails[name]))
        return block

    def _survey(self, reader: ShardReader) -> Source:
        if self._split:
            reader.take(self._split.holds(self._part, reader))
        hand = str(reader.attributes["hand_sha256"])
        return Source(reader.path, len(reader), hand, reader.object_keys, reader.space_names, dict(reader.columns))


def _failed_bounds(sources: Sequence[Source]) -> tuple[str, ...]:
    for source in sources:
        if "metrics/failed_bound" in source.columns:
            with ShardReader(source.path) as reader:
                return tuple(reader.rows(0, 0).failed_bounds)
    return ()


def _label(sources: Sequence[Source]) -> None:
    """Shards without negatives have the labels, too, that others of them have."""
    for name in _OF_VALID:
        if any(name in source.columns for source in sources):
            for source in sources:
                source.columns.setdefault(name, ((source.rows,), np.dtype(np.float32)))


class GraspDataset(TorchRows, torch.utils.data.Dataset):
    """All rows of shards of one hand, each a dictionary of tensors that the default collate function can stack.

    Keys are the flat names of the row datasets: ``q``, ``object_pose``, ..., ``metrics/NAME``, ``physics/NAME``, with
    the shapes of :class:`GraspRows` less the first axis, padded to the widest shard. ``object_index`` counts in
    :attr:`objects`, the objects of all shards; ``candidate`` is int64. If all shards are of sequences, there are
    ``sequence/NAME`` too: ``sequence/space`` counts in :attr:`space_names`, ``sequence/parent`` in this data set.

    Blocks of 4096 rows are decoded at a time and the last used ones kept, so sequential reading is fast at any size and
    random reading as long as the data fits ``cache_bytes``. No file stays open: safe with worker processes, forked or
    spawned, and with any number of shards; give a DataLoader with workers ``persistent_workers=True``, or they read all
    anew in every epoch. Shards that are missing from a folder, or not listed, by its ``manifest.json`` are reported.

    Args:
        paths, columns, negatives, split, part: as of :class:`TorchRows`.
        cache_bytes: Memory for decoded blocks, per worker process.

    Raises:
        ShardError: A shard cannot be read, hands differ, or a shard lacks a column.
        ConfigError: The split cannot be read, or has no such part.
    """

    def __init__(
        self,
        paths: Paths,
        *,
        columns: Sequence[str] | None = None,
        cache_bytes: int = 1 << 29,
        negatives: bool = False,
        split: Split | str | Path | None = None,
        part: str | None = None,
    ) -> None:
        super().__init__(paths, columns, negatives, split, part)
        self._cache_bytes = cache_bytes
        self._cache: OrderedDict[tuple[int, int], dict[str, torch.Tensor]] = OrderedDict()
        self._held = 0  # bytes in it

    def __len__(self) -> int:
        return self._ends[-1]

    def __getitem__(self, index: int) -> dict[str, torch.Tensor]:
        return self.__getitems__([index])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[dict[str, torch.Tensor]]:
        """Many rows at once, as a DataLoader asks for them; each block is touched once."""
        by_block: dict[tuple[int, int], tuple[list[int], list[int]]] = {}
        for position, index in enumerate(indices):
            shard, row = self._locate(int(index))
            positions, rows = by_block.setdefault((shard, row // CHUNK_ROWS), ([], []))
            positions.append(position)
            rows.append(row % CHUNK_ROWS)
        items: list[dict[str, torch.Tensor]] = [{} for _ in indices]
        for (shard, number), (positions, rows) in by_block.items():
            for name, values in self._block(shard, number).items():
                for position, value in zip(positions, values[rows].unbind(0), strict=True):
                    items[position][name] = value
        return items

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_cache": OrderedDict(), "_held": 0}

    def split(
        self, *, by: GroupName, shares: Sequence[float] = (0.8, 0.1, 0.1), seed: int = 0
    ) -> list[torch.utils.data.Subset]:
        """Parts of about some shares of the rows, as :func:`~lgrasp.dataset.split.draw_split` draws them.

        Args:
            by: ``object`` or ``pose`` (all rows are of one hand).
            shares: of the rows, positive; they are divided by their sum.

        Raises:
            ShardError: There are fewer groups than parts.
            ValueError: ``by`` or ``shares`` is out of range.
        """
        if by not in ("object", "pose") or not shares or min(shares) <= 0:
            raise ValueError(
                f"by={by!r}, shares={tuple(shares)}: by is object or pose (it has one hand), shares are positive"
            )
        groups = []
        for source in self._sources:
            with self._open(source) as reader:
                groups.append(read_groups(reader, by, seed))
        drawn = draw_split(groups, by=by, shares={str(k): share for k, share in enumerate(shares)}, seed=seed)
        rows: list[list[int]] = [[] for _ in shares]
        for source, end in zip(self._sources, self._ends, strict=True):
            with self._open(source) as reader:
                numbers = drawn.numbers(reader)
            for k, own in enumerate(rows):
                own += (np.flatnonzero(numbers == k) + end - source.rows).tolist()
        return [torch.utils.data.Subset(self, own) for own in rows]

    def _locate(self, index: int) -> tuple[int, int]:
        size = len(self)
        if not -size <= index < size:
            raise IndexError(f"row {index} of {size}")
        index %= size
        shard = bisect_right(self._ends, index)
        return shard, index - self._ends[shard] + self._sources[shard].rows

    def _block(self, shard: int, number: int) -> dict[str, torch.Tensor]:
        key = (shard, number)
        if key not in self._cache:
            self._cache[key] = self._read(shard, number * CHUNK_ROWS, (number + 1) * CHUNK_ROWS)
            self._held += _bytes(self._cache[key])
            while len(self._cache) > 1 and self._held > self._cache_bytes:
                self._held -= _bytes(self._cache.popitem(last=False)[1])
        self._cache.move_to_end(key)
        return self._cache[key]


def _bytes(block: dict[str, torch.Tensor]) -> int:
    return sum(values.nbytes for values in block.values())

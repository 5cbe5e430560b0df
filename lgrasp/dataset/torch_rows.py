"""Rows of many shards of one hand as tensors: what data sets of PyTorch read."""

from collections.abc import Sequence
from itertools import accumulate
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from lgrasp.dataset.files import Paths
from lgrasp.dataset.gather import gather
from lgrasp.dataset.manifest import tell_differences
from lgrasp.dataset.merge import pad_column, widest
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.split import Split
from lgrasp.errors import ShardError
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.grasp.schema import SEQUENCE_FIELDS


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


class TorchRows:
    """Rows of shards of one hand; no file stays open.

    Args:
        paths: Shard files, or folders of any depth; what cannot be used in these is left out, with a notice.
        columns: Names to return; by default all that every shard has.
        negatives: Rows with metric ``valid`` 0 too, which fail a bound; :attr:`failed_bounds` names it by the code in
            column ``metrics/failed_bound``.
        split: Only rows of a ``part`` of this split (of :meth:`GraspDataset.split`, or a file of ``lgrasp dataset
            split``).

    Raises:
        ShardError: A shard cannot be read, hands differ, or a shard lacks a column.
        ConfigError: The split cannot be read, or has no such part.
    """

    def __init__(
        self, paths: Paths, columns: Sequence[str] | None, negatives: bool, split: Split | str | Path | None, part: str
    ) -> None:
        self._negatives, self._part = negatives, part
        self._split = split if split is None or isinstance(split, Split) else Split.read(split)
        found = [shard.value for shard in gather(paths, self._survey, invalid=negatives)]
        self._sources = [source for source in found if source.rows] if self._split else found
        if not self._sources:
            raise ShardError(f"{found[0].path}: no row is in part '{part}' of the split ({len(found)} shards)")
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
        with self._open(first) as reader:
            self.failed_bounds: tuple[str, ...] = tuple(reader.rows(0, 0).failed_bounds)
        """Names of the numbers in ``metrics/failed_bound``, if the first shard has it."""
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
        return Source(reader.path, len(reader), hand, reader.object_keys, reader.space_names, reader.columns)

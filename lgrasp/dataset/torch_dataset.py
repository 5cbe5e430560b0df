"""Grasps of many shards as a map-style PyTorch Dataset."""

from bisect import bisect_right
from collections import OrderedDict
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from lgrasp.choices import GroupName
from lgrasp.dataset.files import Paths
from lgrasp.dataset.split import Split, draw_split, read_groups
from lgrasp.dataset.torch_rows import TorchRows
from lgrasp.grasp.schema import CHUNK_ROWS


class GraspDataset(TorchRows, torch.utils.data.Dataset):
    """All rows of shards of one hand, each a dictionary of tensors that the default collate function can stack.

    Keys are the flat names of the row datasets: ``q``, ``object_pose``, ..., ``metrics/NAME``, ``physics/NAME``, with
    the shapes of :class:`GraspRows` less the first axis, padded to the widest shard. ``object_index`` counts in
    :attr:`objects`, the objects of all shards; ``candidate`` is int64. If all shards are of sequences, there are
    ``sequence/NAME`` too: ``sequence/space`` counts in :attr:`space_names`, ``sequence/parent`` in this data set.

    Blocks of 4096 rows are decoded at a time and the last used ones kept, so sequential reading is fast at any size and
    random reading as long as the data fits ``cache_bytes``. No file stays open: safe with worker processes, forked or
    spawned, and with any number of shards. Shards that are missing from a folder, or not listed, by its
    ``manifest.json`` are reported.

    Args:
        paths, columns, negatives, split, part: as of :class:`~lgrasp.dataset.torch_rows.TorchRows`.
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
        part: str = "train",
    ) -> None:
        super().__init__(paths, columns, negatives, split, part)
        self._cache_bytes = cache_bytes
        self._cache: OrderedDict[tuple[int, int], dict[str, torch.Tensor]] = OrderedDict()

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
        return {**self.__dict__, "_cache": OrderedDict()}

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
                for k, own in enumerate(rows):
                    own += (np.flatnonzero(drawn.holds(str(k), reader)) + end - source.rows).tolist()
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
            while len(self._cache) > 1 and self._held_bytes() > self._cache_bytes:
                self._cache.popitem(last=False)
        self._cache.move_to_end(key)
        return self._cache[key]

    def _held_bytes(self) -> int:
        return sum(values.nbytes for block in self._cache.values() for values in block.values())

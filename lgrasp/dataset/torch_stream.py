"""Grasps of many shards as a stream: for data larger than memory."""

from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from lgrasp.dataset.files import Paths
from lgrasp.dataset.split import Split
from lgrasp.dataset.torch_dataset import TorchRows
from lgrasp.grasp.schema import CHUNK_ROWS

Rows = dict[str, torch.Tensor]
"""Columns of some rows."""


class GraspIterableDataset(TorchRows, torch.utils.data.IterableDataset):
    """All rows of shards of one hand, each once an epoch, read block by block in bounded memory.

    Rows are those of :class:`GraspDataset`. Blocks of 4096 rows come in random order through a buffer, from which rows
    are drawn at random: the seed and the epoch decide the order. Worker processes and the processes of a distributed
    training (of ``torch.distributed``, or ``rank`` of ``ranks``) share the rows evenly, to one row.

    Args:
        paths, columns, negatives, split, part: as of :class:`~lgrasp.dataset.torch_dataset.TorchRows`.
        batch: Rows of a batch, for ``DataLoader(data, batch_size=None)``, many times as fast as collating rows; 0: rows
            one by one.
        buffer: Rows among which each next one is drawn, per worker process; 0: rows in the order of the shards.
        seed: Of the order.
        rank, ranks: Which process of how many this is; by default as ``torch.distributed`` says, if it is in use.

    Raises:
        ShardError: A shard cannot be read, hands differ, or a shard lacks a column.
        ConfigError: The split cannot be read, or has no such part.
    """

    def __init__(
        self,
        paths: Paths,
        *,
        columns: Sequence[str] | None = None,
        batch: int = 0,
        buffer: int = 65_536,
        seed: int = 0,
        rank: int | None = None,
        ranks: int | None = None,
        negatives: bool = False,
        split: Split | str | Path | None = None,
        part: str | None = None,
    ) -> None:
        super().__init__(paths, columns, negatives, split, part)
        together = torch.distributed.is_available() and torch.distributed.is_initialized()
        self._ranks = ranks if ranks is not None else torch.distributed.get_world_size() if together else 1
        self._rank = rank if rank is not None else torch.distributed.get_rank() if together else 0
        if not 0 <= self._rank < self._ranks or min(batch, buffer) < 0:
            raise ValueError(
                f"rank={self._rank}, ranks={self._ranks}, batch={batch}, buffer={buffer}: ranks count from 0, "
                "batch and buffer are 0 or more"
            )
        if not self.columns:
            raise ValueError("columns=[]: name at least one, or leave columns out for all")
        self._batch, self._buffer, self._seed = batch, buffer, seed
        self._epoch = torch.zeros((), dtype=torch.int64).share_memory_()  # worker processes that stay see it too

    def set_epoch(self, epoch: int) -> None:
        """Say which epoch comes: each has its own order. Without, all have that of epoch 0."""
        self._epoch.fill_(epoch)

    def __len__(self) -> int:
        """Rows of this rank an epoch; batches if it gives batches, as one process reads them."""
        first, last = self._share(self._rank, self._ranks)
        return -(-(last - first) // self._batch) if self._batch else last - first

    def __iter__(self) -> Iterator[dict[str, torch.Tensor]]:
        worker = torch.utils.data.get_worker_info()
        workers, number = (worker.num_workers, worker.id) if worker else (1, 0)
        consumer, told = self._rank * workers + number, (self._seed, int(self._epoch))
        order = np.random.default_rng(told) if self._buffer else None  # the same for all
        blocks = self._blocks(order, consumer, self._ranks * workers)
        if self._buffer:
            blocks = self._mixed(blocks, np.random.default_rng((*told, consumer)))
        yield from self._batches(blocks) if self._batch else _single(blocks)

    def _share(self, consumer: int, consumers: int) -> tuple[int, int]:
        """First row and end of what a consumer reads of the blocks one after another."""
        return consumer * self._ends[-1] // consumers, (consumer + 1) * self._ends[-1] // consumers

    def _blocks(self, order: np.random.Generator | None, consumer: int, consumers: int) -> Iterator[Rows]:
        """What a consumer reads, block by block, these in random order if there is one for all."""
        starts = [(shard, at) for shard, s in enumerate(self._sources) for at in range(0, s.rows, CHUNK_ROWS)]
        chosen = order.permutation(len(starts)) if order else np.arange(len(starts))
        first, last = self._share(consumer, consumers)
        done = 0
        for shard, start in (starts[k] for k in chosen):
            rows = min(CHUNK_ROWS, self._sources[shard].rows - start)
            low, high = max(first - done, 0), min(last - done, rows)
            if low < high:
                yield self._read(shard, start + low, start + high)
            done += rows

    def _mixed(self, blocks: Iterator[Rows], rng: np.random.Generator) -> Iterator[Rows]:
        """The rows in random order: every block takes the place of as many rows of a pool, which go."""
        parts: list[Rows] = []
        missing = self._buffer
        pool: Rows = {}
        for block in blocks:
            if missing:
                taken = _take(block, slice(missing))
                parts.append(taken)
                missing -= len(taken[self.columns[0]])
                block = _take(block, slice(len(taken[self.columns[0]]), None))
                if not missing:
                    pool, parts = _joined(parts), []
            rows = len(block[self.columns[0]])
            for start in range(0, rows, self._buffer):
                new = _take(block, slice(start, start + self._buffer))
                place = torch.from_numpy(rng.choice(self._buffer, len(new[self.columns[0]]), replace=False))
                yield _take(pool, place)
                for name, values in new.items():
                    pool[name][place] = values
        pool = _joined(parts) if parts else pool
        if pool:
            yield _take(pool, torch.from_numpy(rng.permutation(len(pool[self.columns[0]]))))

    def _batches(self, blocks: Iterator[Rows]) -> Iterator[Rows]:
        """The same rows, ``batch`` at a time."""
        left: list[Rows] = []
        count = 0
        for block in blocks:
            left.append(block)
            count += len(block[self.columns[0]])
            if count >= self._batch:
                whole = _joined(left)
                for start in range(0, count - count % self._batch, self._batch):
                    yield _take(whole, slice(start, start + self._batch))
                left, count = [_take(whole, slice(count - count % self._batch, None))], count % self._batch
        if count:
            yield _joined(left)


def _take(rows: Rows, some: slice | torch.Tensor) -> Rows:
    return {name: values[some] for name, values in rows.items()}


def _joined(parts: list[Rows]) -> Rows:
    return {name: torch.cat([part[name] for part in parts]) for name in parts[0]}


def _single(blocks: Iterator[Rows]) -> Iterator[Rows]:
    for block in blocks:
        for values in zip(*(column.unbind(0) for column in block.values()), strict=True):
            yield dict(zip(block, values, strict=True))

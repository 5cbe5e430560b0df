"""Jobs that make a file of every shard that they are given."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from lgrasp.config import ShardPaths
from lgrasp.dataset.files import remove_leftovers, shard_tree
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Part
from lgrasp.engine.folder import MADE_FROM
from lgrasp.engine.run import Job
from lgrasp.errors import OutputError
from lgrasp.grasp.records import Shard

_ROW = ("q", "q_pregrasp", "q_squeeze", "object_pose", "object_index", "candidate")
_BATCH_ROWS = 65_536  # at a time


class ShardJob(Job):
    """A part is a shard, written under its place in the output folder."""

    kernels: ClassVar[tuple[str, ...]] = ()
    one_key: ClassVar[bool] = False
    differs: ClassVar[str] = "other grasps or parameters, or another protocol"

    shards: ShardPaths
    out: Path = Field(description="Folder of the files, under the places of the shards.")

    @property
    def title(self) -> str:
        return f"{' '.join(path.name for path in self.shards)} -> {self.folder}"

    @property
    def folder(self) -> Path:
        return self.out

    def parts(self) -> list[Part]:
        out = self.folder
        inside = out.is_dir() and any(path.resolve() in out.resolve().parents for path in self.shards)
        found = shard_tree(self.shards, leave_out=out if inside else None)
        parts = [
            Part(number, self.folder / place, shard_rows(source), source)
            for number, (place, source) in enumerate(found.items())
        ]
        for part in parts:
            assert part.source is not None
            if part.file.exists() and part.file.samefile(part.source):
                raise OutputError(f"{part.source} would be overwritten; choose another folder with --out")
        return parts

    def clean(self, parts: Sequence[Part]) -> None:
        for folder in {part.file.parent for part in parts}:
            remove_leftovers(folder, "*.h5.tmp")

    def part_key(self, part: Part) -> str:
        """Content key of the job and of the rows of a part's source."""
        assert part.source is not None
        return content_key("part", 1, job=self.key(), rows=rows_digest(part.source))

    def marked(self, part: Part, shard: Shard, statistics: Mapping[str, int | float | str]) -> Shard:
        """The shard with more statistics, and what tells that it is this part of this job."""
        return replace(shard, statistics={**shard.statistics, **statistics, MADE_FROM: self.part_key(part)})


def shard_rows(path: Path) -> int:
    """Rows of a shard.

    Raises:
        ShardError: it cannot be read.
    """
    with ShardReader(path) as reader:
        return len(reader)


def rows_digest(path: Path) -> str:
    """SHA-256 of the identity of the rows of a shard: joints, poses, objects, candidates."""
    h = hashlib.sha256()
    with ShardReader(path) as reader:
        for name in _ROW:
            for first in range(0, len(reader), _BATCH_ROWS):
                values: Any = reader.column(name, first, min(first + _BATCH_ROWS, len(reader)))
                h.update(np.ascontiguousarray(values).tobytes())
    return h.hexdigest()

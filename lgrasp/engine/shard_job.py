"""Jobs that make a file of every shard that they are given."""

import hashlib
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from lgrasp.dataset.differences import tell_differences
from lgrasp.dataset.extend import extend_shard
from lgrasp.dataset.files import named_files
from lgrasp.dataset.gather import gather, sound_files
from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Part
from lgrasp.engine.request import ShardRequest
from lgrasp.engine.run import Job
from lgrasp.errors import OutputError, ShardError
from lgrasp.files import locked, remove_leftovers
from lgrasp.grasp.records import Shard
from lgrasp.grasp.schema import MADE_FROM, POSTURES

_ROW = (*POSTURES, "object_pose", "object_index", "candidate")
_BATCH_ROWS = 65_536  # at a time


class ShardJob(ShardRequest, Job):
    """A part is a shard, written under its place in the output folder."""

    kernels: ClassVar[tuple[str, ...]] = ()
    one_key: ClassVar[bool] = False
    differs: ClassVar[str] = "other grasps or parameters, or another protocol"

    _hands: set[str] = PrivateAttr(default_factory=set)
    _objects: set[str] = PrivateAttr(default_factory=set)

    def parts(self) -> list[Part]:
        def look(reader: ShardReader) -> tuple[int, int]:
            self.check_source(reader)
            self._hands.add(str(reader.attributes["hand"]))
            self._objects.update(reader.object_ids)
            return len(reader), reader.header.shard_index

        if not self.in_place:
            tell_differences(self.shards, self.inside)
        out, parts, places = self.folder, [], {}
        for number, (source, place, (rows, index)) in enumerate(gather(self.shards, look, leave_out=self.inside)):
            parts.append(Part(number, source if self.in_place else out / place, rows, source, index))
            if not self.in_place and (other := places.setdefault(place, source)) != source:
                raise ShardError(f"{source}: it has the same place {place} as {other}; name one folder above both")
        for part in parts:
            assert part.source is not None
            if not self.in_place and part.file.exists() and part.file.samefile(part.source):
                raise OutputError(f"{part.source} would be overwritten; choose another folder with --out")
        return parts

    def check_source(self, reader: ShardReader) -> None:
        """Raise ShardError if a shard is none for this job; among others in a folder it is left out."""

    def whole(self, parts: list[Part], *, some: bool) -> list[Part]:
        def check(path: Path) -> None:
            with ShardReader(path) as reader:
                reader.check_whole()

        if not parts:
            return []
        sources = [part.source for part in parts if part.source]
        sound = {path for path, *_ in sound_files(sources, check, named=named_files(self.shards), some=some)}
        return [part for part in parts if part.source in sound]

    def about(self) -> dict[str, Any]:
        return {"hand": ", ".join(sorted(self._hands)), "objects": sorted(self._objects)}

    def clean(self, parts: Sequence[Part]) -> None:
        for folder in {part.file.parent for part in parts}:
            remove_leftovers(folder, "*.h5.tmp")

    def part_key(self, part: Part) -> str:
        """Content key of the job and of the rows of a part's source."""
        assert part.source is not None
        with ShardReader(part.source) as reader:
            return self.key_of(reader)

    def key_of(self, reader: ShardReader) -> str:
        """Content key of the job and of the rows of an open shard."""
        return content_key("part", 1, job=self.key(), rows=self.digest(reader))

    def digest(self, reader: ShardReader) -> str:
        """:func:`rows_digest`, of further columns too where the job goes by them."""
        return rows_digest(reader)

    def write(self, part: Part, contents: Any) -> None:
        """Write the file of a part: its source with more columns. Of several processes that add to one shard, each adds
        to what the others wrote.

        Args:
            contents: :meth:`key_of` the rows that the columns are of, and what :func:`extend_shard` adds.

        Raises:
            ShardError: the source has other rows by now.
        """
        assert part.source is not None
        key, added = contents
        with locked(part.source) if self.in_place else nullcontext():
            if self.part_key(part) != key:
                raise ShardError(f"{part.source}: its rows were replaced while they were worked on; run it again")
            extend_shard(self.extended(part), part.file, **added)

    def extended(self, part: Part) -> Path:
        """The file that has the columns of a part but for those that are added."""
        assert part.source is not None
        return part.source

    def marked(self, shard: Shard, key: str, statistics: Mapping[str, int | float | str]) -> Shard:
        """The shard with more statistics, and the :meth:`part_key` that tells what it was made from."""
        return replace(shard, statistics={**shard.statistics, **statistics, MADE_FROM: key})


def rows_digest(reader: ShardReader, more: Sequence[str] = ()) -> str:
    """SHA-256 of what the rows of a shard are: hand, objects, joints, poses, candidates; and of more columns."""
    h = hashlib.sha256(repr((str(reader.attributes["hand_sha256"]), reader.object_keys)).encode())
    for name in (*_ROW, *more):
        for first in range(0, len(reader), _BATCH_ROWS):
            values: Any = reader.column(name, first, min(first + _BATCH_ROWS, len(reader)))
            h.update(np.ascontiguousarray(values).tobytes())
    return h.hexdigest()

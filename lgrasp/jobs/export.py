"""Grasps in the format of another program: one folder that can be used alone, made as a whole."""

import json
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from lgrasp.dataset.conditions import parse_condition
from lgrasp.dataset.differences import tell_differences
from lgrasp.dataset.exports.folder import INDEX
from lgrasp.dataset.exports.formats import FORMATS, export_shards
from lgrasp.dataset.exports.mjcf import Cut
from lgrasp.dataset.exports.selection import chosen_rows, number_columns, verdict_columns
from lgrasp.dataset.gather import gather
from lgrasp.dataset.reader import ShardReader
from lgrasp.dataset.split import Split
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import JobOutcome, Made, Part, PartProgress
from lgrasp.engine.run import Job
from lgrasp.engine.shard_job import rows_digest
from lgrasp.errors import OutputError
from lgrasp.grasp.records import HandRecord, ObjectRecord
from lgrasp.grasp.schema import TABLE_FIELDS
from lgrasp.jobs.requests.shards import ExportRequest


class ExportJob(ExportRequest, Job):
    """Grasps of shards, all of one hand, with the hand's URDF and all meshes."""

    command: ClassVar[str] = "export"
    part: ClassVar[str] = "export"
    kernels: ClassVar[tuple[str, ...]] = ()

    def key(self) -> str:
        where = [parse_condition(text) for text in self.where]
        columns = {condition.column for condition in where} | {*TABLE_FIELDS}

        def digest(reader: ShardReader) -> str:
            chosen_rows(reader, where, single=FORMATS[self.to].single)  # the files that the export leaves out
            numbers = number_columns(reader) if self.to == "webdataset" else ()
            return rows_digest(reader, sorted(columns & reader.columns.keys() | {*verdict_columns(reader), *numbers}))

        rows = [shard.value for shard in gather(self.shards, digest)]
        options = {"limit": self.limit, "where": list(self.where), "licence": self.licence}
        parts = Split.read(self.split).model_dump(mode="json") if self.split else None
        return content_key("export", 5, to=self.to, rows=rows, split=parts, **options)

    def parts(self) -> list[Part]:
        tell_differences(self.shards)
        return [Part(0, self.out / INDEX)]

    def present(self, parts: Sequence[Part]) -> dict[int, int]:
        if not parts or not parts[0].file.is_file():
            return {}
        try:
            index = json.loads(parts[0].file.read_bytes())
            known, rows = index.get("run_key"), int(index["rows"])
        except (ValueError, KeyError, TypeError, AttributeError):
            return {}
        if known != self.key():
            raise OutputError(f"{self.out} is not empty: it holds another export; choose another --out")
        return {0: rows}

    def make(self, part: Part, progress: PartProgress) -> Made:
        how: dict[str, Any] = {name: getattr(self, name) for name in ("where", "limit", "split", "licence")}
        how |= {"run_key": self.key(), "cut": self._cut(progress) if self.to == "mjcf" else None}

        def advance(done: int, total: int) -> None:
            replace(progress, part=replace(part, rows=total))(done)

        # a whole one is only here if it is to be replaced
        done = export_shards(self.shards, self.out, self.to, advance=advance, replaces=True, **how)
        return Made(done.rows, (), list(done.objects))

    def write(self, part: Part, contents: Any) -> None:
        """The export is on disk: its files are many, and written as they are made."""

    def report(self, outcome: JobOutcome) -> dict[str, Any]:
        """``grasps``, ``objects`` (their codes), ``format``."""
        objects = [code for path in outcome.paths for code in json.loads(path.read_bytes())["objects"]]
        return {"grasps": outcome.rows, "objects": objects, "format": self.to}

    def _cut(self, progress: PartProgress) -> Cut:
        """Convex pieces as the simulation makes them, from the cache; approximations of objects are reported."""
        from lgrasp.jobs.records import cutter
        from lgrasp.simulate.assemble import inflated
        from lgrasp.simulate.scene import hand_of_record
        from lgrasp.simulate.solid import object_of_record

        decompose = cutter(self.cache, self.events, progress)

        def of_object(record: ObjectRecord) -> Sequence[np.ndarray]:
            solid = object_of_record(record, decompose)
            for note in solid.notes:
                self.cache.warn(f"object '{record.name}': {note}")
            return solid.pieces

        def of_hand(record: HandRecord) -> dict[str, list[np.ndarray]]:
            hand = hand_of_record(record, decompose)
            return {link: [inflated(piece) for piece in hand.pieces[link]] for link in sorted(hand.cut)}

        return Cut(of_object, of_hand)

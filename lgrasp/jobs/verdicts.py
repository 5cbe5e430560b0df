"""What the jobs share that add verdicts to shards: columns ``physics/...`` whose protocol tells how they were found."""

import json
from abc import abstractmethod
from pathlib import Path
from typing import Any, ClassVar

from lgrasp.dataset.reader import ShardReader
from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Part
from lgrasp.engine.folder import Found
from lgrasp.engine.shard_job import ShardJob
from lgrasp.errors import ShardError
from lgrasp.jobs.difference import config_difference
from lgrasp.jobs.requests.shards import VerdictRequest


class VerdictJob(VerdictRequest, ShardJob):
    """Adds verdicts to shards, in place or to copies."""

    version: ClassVar[int]
    """Raised whenever the same settings give other verdicts; among the settings."""

    @property
    @abstractmethod
    def verdict(self) -> tuple[str, str]:
        """Name of the verdicts, and of the column that every shard with them has."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """What decides a verdict besides its row, as far as it is the same for all shards."""

    def told(self, protocol: dict[str, Any]) -> dict[str, Any]:
        """The settings that verdicts were made with, from the protocol that a shard tells."""
        return {name: protocol[name] for name in self.settings() if name in protocol}

    def key(self) -> str:
        return content_key(self.command, self.version, settings=self.settings())

    def parts(self) -> list[Part]:
        parts = super().parts()
        if not any(part.rows for part in parts):
            raise ShardError(f"{', '.join(map(str, self.shards))}: no grasps to give verdicts of")
        return parts

    def found(self, part: Part) -> Found | None:
        if not self.in_place:  # else the source was checked
            super().found(part)
        with ShardReader(part.file) as reader:
            text = self._protocol(reader)
            if text is None and self.in_place:
                return None
            rows, digest = len(reader), self.digest(reader)
        job = content_key(self.command, self.version, settings=self._read(text or "{}"))
        return Found(content_key("part", 1, job=job, rows=digest), rows)

    def refusal(self, path: Path) -> str:
        if not self.in_place:
            return super().refusal(path)
        return f"{path} has other verdicts of {self.verdict[0]} ({self.difference(path)}); --overwrite replaces them"

    def difference(self, path: Path) -> str:
        with ShardReader(path) as reader:
            text = self._protocol(reader)
        if text is None:
            return "it has no verdicts of this protocol"
        return config_difference(self._read(text), self.settings()) or "other grasps"

    def _protocol(self, reader: ShardReader) -> str | None:
        return reader.rows(0, 0).physics_protocols.get(self.verdict[1])

    def _read(self, text: str) -> dict[str, Any]:
        try:
            return self.told(json.loads(text))
        except (ValueError, AttributeError, TypeError, RecursionError):
            return {}

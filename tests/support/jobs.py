"""A job that makes shards of samples at once."""

from dataclasses import replace
from pathlib import Path
from typing import ClassVar

from support.shards import sample_shard

from lgrasp.engine.cache import content_key
from lgrasp.engine.events import Events, JobOutcome, Made, Part, PartProgress
from lgrasp.engine.folder import Found, shard_path
from lgrasp.engine.run import Job


class SampleJob(Job):
    """``rows`` rows in shards of two, of which ``most`` can be found."""

    command: ClassVar[str] = "sample"
    kernels: ClassVar[tuple[str, ...]] = ()
    asks: ClassVar[bool] = True

    out: Path
    rows: int = 6
    most: int = 1000
    seed: int = 0
    name: str = "cup"

    @property
    def folder(self) -> Path:
        return self.out

    def key(self) -> str:
        return content_key("sample", 1, seed=self.seed, name=self.name)

    def about(self):
        return {"hand": "toy", "objects": [self.name], "seed": self.seed}

    def parts(self) -> list[Part]:
        sizes = [min(2, self.rows - first) for first in range(0, self.rows, 2)]
        return [Part(n, shard_path(self.out, "toy", self.name, n), size) for n, size in enumerate(sizes)]

    def make(self, part: Part, progress: PartProgress) -> Made:
        rows = max(0, min(part.rows, self.most - 2 * part.number))
        progress(rows)
        shard = sample_shard(rows, shard_index=part.number)
        statistics = {"exhausted": int(rows < part.rows), "candidates": 1}
        header = replace(shard.header, config={"run_key": self.key()})
        return Made(rows, replace(shard, header=header, statistics=statistics))

    def gave_up(self, rows: int, found: Found) -> bool:
        return found.tried >= 1

    def report(self, outcome: JobOutcome):
        return {}


class StopAfter(Events):
    """Stops a job after some of its parts."""

    def __init__(self, parts: int) -> None:
        self.left = parts

    def advanced(self, part, done, *more):
        self.left -= 1

    def cancelled(self) -> bool:
        return self.left <= 0

"""What is asked of a job, without what does it: light to import, so that what cannot be is told at once."""

from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Any, ClassVar

from pydantic import ConfigDict, Field

from lgrasp.config import DeviceName, Params, ShardPaths, Workers
from lgrasp.dataset.files import shards_below
from lgrasp.outputs import check_folder

if TYPE_CHECKING:
    from lgrasp.engine.cache import Cache


class Request(Params):
    """Settings of a job: the keys of a config (``lgrasp run``), the options of a command."""

    model_config = ConfigDict(frozen=False, arbitrary_types_allowed=True)

    maker: ClassVar[str] = ""
    """Where the job is: ``module:class``."""
    unit: ClassVar[str] = "grasps"
    """What is counted."""
    part: ClassVar[str] = "shard"
    """What a part is."""

    device: DeviceName = "auto"
    workers: Workers = 0

    @property
    def title(self) -> str:
        """Title of the job, in a few words."""
        return str(getattr(self, "out", self.unit))

    @property
    def in_place(self) -> bool:
        """True if the parts are made in files of other runs, which stay theirs."""
        return False

    @property
    def known_parts(self) -> int | None:
        """Number of parts; None: only the job can tell."""
        return None

    def check(self) -> None:
        """Look up names, numbers and paths; nothing is loaded.

        Raises:
            LgraspError: one of them cannot be.
        """

    def job(self, cache: "Cache") -> Any:
        """The job, whose module is imported now."""
        return resolve_name(self.maker)(**self.values(), cache=cache)

    def values(self) -> dict[str, Any]:
        """Every field with its value."""
        return {name: getattr(self, name) for name in type(self).model_fields}


class ShardRequest(Request):
    """A file of every shard that is given."""

    shards: ShardPaths
    out: Path | None = Field(description="Folder of the files, under the places of the shards.")

    @property
    def folder(self) -> Path:
        """Where the files go."""
        assert self.out is not None
        return self.out

    @property
    def title(self) -> str:
        return f"{' '.join(path.name for path in self.shards)} -> {self.folder}"

    def check(self) -> None:
        check_folder(self.folder)
        shards_below(self.shards, self.inside)

    @property
    def known_parts(self) -> int | None:
        return len(shards_below(self.shards, self.inside))

    @property
    def inside(self) -> Path | None:
        """The folder of the files if it is in one of the shards', in which it is not looked for shards then."""
        if self.in_place or not self.folder.is_dir():
            return None
        return self.folder if any(path.resolve() in self.folder.resolve().parents for path in self.shards) else None

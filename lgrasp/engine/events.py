"""Parts of a job, their results and those of the job, and the events of a running job."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lgrasp.runtime.device import Device


class CancelledError(Exception):
    """The user asked a job to stop; the part being made is dropped, whole parts stay."""


@dataclass(frozen=True)
class Part:
    """One file that a job makes, independent of its other parts."""

    number: int
    file: Path
    rows: int = 0
    """Rows (or scenes, or steps) that are asked, or that the source holds; 0: not known before."""
    source: Path | None = None
    """What it is made of, where that is a file."""
    index: int | None = None
    """Index of the shard in the run that its rows are of, where it is not the number."""

    @property
    def shard_index(self) -> int:
        """Index of the shard that the file holds."""
        return self.number if self.index is None else self.index


@dataclass
class Made:
    """Result of one part."""

    rows: int
    contents: Any = None
    """What is to be written; forgotten when it is on disk. None: there is nothing to write."""
    result: Any = None
    """What the report needs of it; kept until the job ends."""
    kept: int = 0
    """Rows of it that an earlier run made."""


@dataclass
class JobOutcome:
    """Result of a call of :func:`lgrasp.engine.run.run`."""

    job: Any
    """The job, with what it loaded."""
    device: "Device"
    parts: list[Part]
    """Those of this task."""
    on_disk: dict[int, int]
    """Rows that were there already, by number of the part."""
    made_parts: list[tuple[Part, Made]] = field(default_factory=list)
    """Those that this call wrote."""
    results: list[Any] = field(default_factory=list)
    """Result of each part that this call made, those with nothing to write included."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Of loading kernels, making parts and the whole call [s]."""
    starved: bool = False
    cancelled: bool = False
    stopped: bool = False
    """It was asked to stop, if only when all was made."""
    lanes: int = 1
    """Devices that made parts side by side."""

    @property
    def written(self) -> list[Path]:
        """Files that this call made."""
        return [part.file for part, _ in self.made_parts]

    @property
    def paths(self) -> list[Path]:
        """Files of this task that are on disk."""
        made = {part.number for part, _ in self.made_parts}
        return [part.file for part in self.parts if part.number in self.on_disk or part.number in made]

    @property
    def made(self) -> int:
        """Rows made by this call."""
        return sum(made.rows - made.kept for _, made in self.made_parts)

    @property
    def present(self) -> int:
        """Rows that an earlier run made."""
        return sum(self.on_disk.values()) + sum(made.kept for _, made in self.made_parts)

    @property
    def rows(self) -> int:
        """Rows on disk of this task's parts."""
        return self.made + self.present


class Events:
    """Notifications and queries of a running job; every method may be overridden."""

    def said(self, words: str) -> None:
        """Something that the user had better know before the job begins."""

    def loading(self, what: str, share: float = 0.0) -> None:
        """An input is being loaded or made."""

    def started(self, parts: Sequence[Part], present: Mapping[int, int]) -> None:
        """Inputs are ready; ``present`` are the rows of the parts, by number, that are on disk already."""

    def advanced(self, part: Part, done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        """``done`` rows of a part are made so far, ``kept`` of them before this run; work on ``ahead`` more is done, as
        far as can be told.

        Called on a thread of the part's own where parts are made side by side.
        """

    def wrote(self, part: Part, made: Made) -> None:
        """A part is on disk."""

    def cancelled(self) -> bool:
        """True if the job should stop."""
        return False


@dataclass(frozen=True)
class PartProgress:
    """How the maker of a part tells how far it is; a call ends the part if the job is to stop."""

    events: Events
    part: Part

    def __call__(self, done: int, note: str = "", ahead: float = 0.0, kept: int = 0) -> None:
        """Tell the rows done so far; see :meth:`Events.advanced`.

        Raises:
            CancelledError: the job is to stop, and rows are missing.
        """
        self.events.advanced(self.part, done, note, ahead, kept)
        if not 0 < self.part.rows <= done:
            self.check()

    def check(self) -> None:
        """Raises CancelledError if the job is to stop."""
        if self.events.cancelled():
            raise CancelledError

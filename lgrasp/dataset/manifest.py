"""``manifest.json`` of a folder: the files that its runs were asked for; rows and SHA-256 of those that are there."""

import json
import os
import platform
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from lgrasp.config import parse_model
from lgrasp.dataset.files import (
    parsing,
    sha256,
)
from lgrasp.errors import ConfigError, OutputError, ShardError
from lgrasp.files import held_file, is_held, locked, write_file
from lgrasp.notices import notice

MANIFEST = "manifest.json"
TEMPORARY = "manifest.*.tmp"
"""Pattern of its temporary files, and of those that say that a process works on a run."""
SUFFIX = ".h5"
"""Of the files that are listed."""

_MARK = "manifest.running"
_MAX_BYTES = 64 << 20
_MAX_MARK = 4096  # bytes


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("it has characters that cannot be printed")
    return text


def _one_name(text: str) -> str:
    if text != os.path.basename(text) or text in ("", ".", ".."):
        raise ValueError("it is not the name of a file in the folder")
    return text


_Text = Annotated[str, Field(max_length=4096), AfterValidator(_printable)]
_Count = Annotated[int, Field(ge=0, lt=2**63)]


class _Listed(BaseModel):
    model_config = ConfigDict(strict=True)  # keys of later minor versions are ignored


class ListedShard(_Listed):
    """One file of a run."""

    file: Annotated[_Text, AfterValidator(_one_name)]
    shard_index: int = Field(ge=-1, lt=2**63)
    asked: _Count | None = None
    """Rows that are asked; None: the run does not ask for a number."""
    rows: _Count | None = None
    """Rows that were made, as the run counts them; None: not yet."""
    bytes: _Count | None = None
    sha256: str | None = Field(default=None, pattern=r"^[0-9a-f]{64}$")
    """None with ``rows`` 0: there was nothing to write; with more: the file is being replaced."""

    @property
    def written(self) -> bool:
        """True if there must be a file."""
        return bool(self.sha256 or self.rows)


class ListedRun(_Listed):
    """What a run was asked for in a folder. Files that were there before the manifest are in one without a key."""

    run_key: _Text = ""
    job: _Text = ""
    """The command."""
    unit: _Text = "rows"
    hand: _Text = ""
    objects: list[_Text] = Field(default_factory=list)
    pipeline: _Text | None = None
    seed: int | None = None
    lgrasp_version: _Text = ""
    array: _Text | None = None
    """The SLURM array that shares the files, such as 0-99."""
    shards: list[ListedShard] = Field(default_factory=list)


class Manifest(_Listed):
    """The list of a folder; a file is in one run at most."""

    format: Literal["lgrasp-manifest"] = "lgrasp-manifest"
    format_version: str = Field(default="2.0", pattern=r"^2\.[0-9]+$")
    runs: list[ListedRun] = Field(default_factory=list)

    @property
    def shards(self) -> list[ListedShard]:
        """Files of all runs."""
        return [shard for run in self.runs for shard in run.shards]

    def entries(self, run: ListedRun) -> dict[str, ListedShard]:
        """What is known of files that may be a run's, by name."""
        return {s.file: s for r in self.runs if r.run_key in (run.run_key, "") for s in r.shards}

    def ask(self, run: ListedRun, making: Collection[str], busy: Mapping[str, str]) -> None:
        """Take up what a run is asked for now: what was made stays so unless more rows are asked.

        Files of other runs are this run's from now on, and what else those were asked for and never made is forgotten;
        files of this run that are not asked any more stay while they are on disk.

        Args:
            making: Files that are going to be made.
            busy: Hosts of processes that work on other runs, by key; what these were asked for stays theirs.

        Raises:
            OutputError: A file is one of those.
        """
        theirs = {s.file: busy[r.run_key] for r in self.runs if r.run_key in busy for s in r.shards}
        if taken := sorted(theirs.keys() & {shard.file for shard in run.shards}):
            host = theirs[taken[0]]
            dead = f"; if it was killed on {host}, remove manifest.*.running.tmp" if host != platform.node() else ""
            raise OutputError(f"{taken[0]} is being made by another run; wait for it, or choose another --out{dead}")
        known = {name: shard for name, shard in self.entries(run).items() if name not in making}
        asked = [_carried(shard, known.get(shard.file)) for shard in run.shards]
        names = {shard.file for shard in asked}
        earlier = [s for r in self.runs if r.run_key == run.run_key for s in r.shards if s.file not in names]
        kept = [shard.model_copy(update={"asked": None}) for shard in earlier if shard.written]
        for other in self.runs:
            if other.run_key not in busy and names & {shard.file for shard in other.shards}:
                self.drop({shard.file for shard in other.shards if not shard.written} - names)
        self._give(run.model_copy(update={"shards": asked + kept}), names)

    def record(self, run: ListedRun, shards: Iterable[ListedShard]) -> None:
        """Take up files of a run as they are on disk."""
        made = {shard.file: shard for shard in shards}
        known = [s for r in self.runs if r.run_key == run.run_key for s in r.shards if s.file not in made]
        self._give(run.model_copy(update={"shards": known + list(made.values())}), set(made))

    def renew(self, files: Iterable[Path], *, changing: bool = False, changed: bool = False) -> None:
        """Take up listed files as they are now, in the runs that they are in.

        Args:
            changing: They are going to be replaced: their sizes are not known until they are renewed again.
            changed: They were replaced: what is listed is of the files before, though they may be as large.

        Raises:
            ShardError: One cannot be read.
        """
        by_name = {path.name: path for path in files}

        def renewed(shard: ListedShard) -> ListedShard:
            path = by_name.get(shard.file)
            if path is None or shard.rows is None:
                return shard
            if changing:
                return shard.model_copy(update={"bytes": None, "sha256": None})
            same = not changed and shard.sha256 and shard.bytes == path.stat().st_size
            return shard if same else listed(shard, path, shard.rows)

        self.runs = [run.model_copy(update={"shards": list(map(renewed, run.shards))}) for run in self.runs]

    def drop(self, files: Collection[str]) -> None:
        """Forget files."""
        runs = [r.model_copy(update={"shards": [s for s in r.shards if s.file not in files]}) for r in self.runs]
        self.runs = [r for r in runs if r.shards]

    def _give(self, run: ListedRun, files: set[str]) -> None:
        """Replace a run, which takes some files from the others."""
        array = next((r.array for r in self.runs if r.run_key == run.run_key), None)
        run = run.model_copy(update={"array": run.array or array})
        self.runs = [r for r in self.runs if r.run_key != run.run_key]
        self.drop(files)
        self.runs += [run] if run.shards else []

    def text(self) -> str:
        """The file, the same for the same content."""
        runs = [r.model_copy(update={"shards": sorted(r.shards, key=lambda s: s.file)}) for r in self.runs]
        ordered = self.model_copy(update={"runs": sorted(runs, key=lambda r: (r.shards[0].file, r.run_key))})
        return ordered.model_dump_json(indent=2, exclude_none=True) + "\n"


def _carried(shard: ListedShard, old: ListedShard | None) -> ListedShard:
    """What is asked of a file, with what is known of it if that is enough."""
    if shard.rows is not None or old is None or old.rows is None:
        return shard
    if old.asked != shard.asked and old.rows < (shard.asked or 0):
        return shard
    return shard.model_copy(update={"rows": old.rows, "bytes": old.bytes, "sha256": old.sha256})


def listed(shard: ListedShard, path: Path, rows: int) -> ListedShard:
    """An entry with the size and the SHA-256 of its file.

    Raises:
        ShardError: The file cannot be read.
    """
    digest = sha256(path)
    return shard.model_copy(update={"rows": rows, "bytes": path.stat().st_size, "sha256": digest})


def read_manifest(path: str | os.PathLike[str]) -> Manifest | None:
    """The manifest in a file; None if there is no file, or an empty one, which is being made.

    Raises:
        ShardError: It is damaged, of another version, or no manifest; one line.
    """
    path = Path(path)
    if not os.path.lexists(path):
        return None
    with parsing(path, "a manifest of shards", (ValueError, RecursionError, ConfigError)):
        if not path.is_file():
            raise ValueError("it is no file")
        if (size := path.stat().st_size) > _MAX_BYTES:
            raise ValueError(f"it has {size:,} bytes; at most {_MAX_BYTES:,} are read")
        data = path.read_bytes()
        manifest = parse_model(Manifest, json.loads(data), "manifest") if data else None
        names = [shard.file for shard in manifest.shards] if manifest else []
        if len(set(names)) < len(names):
            raise ValueError("a file is listed twice")
        if manifest:
            manifest.drop(())  # runs without a file
    return manifest


def update_manifest(folder: Path, change: Callable[[Manifest], None]) -> None:
    """Change the manifest of a folder; other processes wait, so that no change is lost.

    One that is missing or damaged (which is said) begins with the shards that are in the folder. The file is written
    only if its content changes, and is always whole; without an entry it is removed.

    Raises:
        OutputError: It cannot be written.
    """
    path = folder / MANIFEST
    if path.exists() and not path.is_file():
        raise OutputError(f"cannot write {path}: it is no file; remove it")
    with locked(path):
        try:
            try:
                manifest = read_manifest(path)
            except ShardError as error:
                notice(f"{error}; writing it again")
                manifest = None
            before = manifest and manifest.text()
            manifest = manifest or Manifest(runs=listed_there(folder))
            change(manifest)
            if not manifest.runs:
                path.unlink()
            elif (text := manifest.text()) != before:
                write_file(path, text)
        finally:
            if path.exists() and not path.stat().st_size:
                path.unlink()


def listed_there(folder: Path) -> list[ListedRun]:
    """The shards in a folder as one run without a key; merged files and what is no shard are left out."""
    from lgrasp.dataset.reader import ShardReader  # slow to load, and not needed to read manifests

    shards = []
    for path in sorted(folder.glob(f"*{SUFFIX}")):
        with suppress(ShardError), ShardReader(path) as reader:
            index, rows = reader.header.shard_index, len(reader)
            if index >= 0 and path.name.isprintable():
                shards.append(listed(ListedShard(file=path.name, shard_index=index), path, rows))
    return [ListedRun(shards=shards)] if shards else []


class Worker(_Listed):
    """A process that works on a run."""

    run_key: _Text
    host: _Text
    pid: int


@contextmanager
def working_on(folder: Path, run_key: str) -> Iterator[None]:
    """Say in a folder, while the block runs, that this process works on a run.

    Raises:
        OutputError: The folder cannot be written.
    """
    worker = Worker(run_key=run_key, host=platform.node(), pid=os.getpid())
    with held_file(folder / _MARK, worker.model_dump_json().encode()):
        yield


def workers(folder: Path) -> list[Worker]:
    """Living processes that work on runs in a folder, as far as locks tell."""
    found = []
    for path in sorted(folder.glob(TEMPORARY)):
        if path.is_file() and ".running" in path.suffixes and is_held(path):
            with suppress(ValueError, OSError):
                found.append(Worker.model_validate_json(path.read_bytes()[:_MAX_MARK]))
    return found

"""What ``manifest.json`` says while a job runs: of its own files what is asked and made, of files of others that it
replaces what they are."""

import threading
import time
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cached_property, partial
from pathlib import Path

from lgrasp.dataset.manifest import (
    MANIFEST,
    SUFFIX,
    TEMPORARY,
    ListedRun,
    ListedShard,
    Manifest,
    listed,
    read_manifest,
    update_manifest,
    workers,
    working_on,
)
from lgrasp.engine.events import Part
from lgrasp.errors import OutputError, ShardError
from lgrasp.files import remove_leftovers, writing

_MOST_LISTING = 0.05  # share of a job's time that manifests may take while it runs


class _Seldom:
    """When manifests may be written while a job runs, so that it takes little of its time."""

    def __init__(self) -> None:
        self._ended, self._took = 0.0, 0.0  # [s]

    @property
    def again(self) -> bool:
        """Whether it is time to."""
        return time.monotonic() - self._ended > self._took / _MOST_LISTING

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Around the writing."""
        begin = time.monotonic()
        yield
        self._ended = time.monotonic()
        self._took = self._ended - begin


class Listing:
    """The entries of a job in the manifests of its folders.

    Args:
        describe: gives the job, without shards; called if there is something to list.
        own: those of this process.
        asks: the parts ask for a number of rows.
    """

    def __init__(
        self, describe: Callable[[], ListedRun], root: Path, every: Sequence[Part], own: Sequence[Part], *, asks: bool
    ) -> None:
        self.folders = _by_folder(own)
        self._describe, self._root, self._every, self._asks = describe, root, _by_folder(every), asks
        self._new = sorted({p for f in (root, *self.folders) for p in (f, *f.parents) if not p.exists()}, reverse=True)
        self._made: dict[Path, dict[str, ListedShard]] = defaultdict(dict)
        self._unlisted: dict[Path, dict[str, tuple[ListedShard, int]]] = defaultdict(dict)  # with the file's time [ns]
        self._lock = threading.Lock()
        self._mark = ExitStack()
        self._seldom = _Seldom()

    @contextmanager
    def kept(self, present: Mapping[int, int]) -> "Iterator[Listing]":
        """Keep the manifests while the parts are made; where nothing is made, nothing is left behind, neither a
        manifest nor a folder.

        Args:
            present: rows of the parts that are there, by number.

        Raises:
            OutputError: a folder cannot be written.
        """
        try:
            self.ask(present)
            yield self
            self.flush()
        except BaseException:
            with suppress(OutputError):  # the first error says more
                self.flush()
            raise
        finally:
            self.close()

    @cached_property
    def run(self) -> ListedRun:
        """The job, without shards."""
        return self._describe()

    def ask(self, present: Mapping[int, int]) -> None:
        """List what is asked, with the rows of the parts that are there, by number; say that this process works.

        Raises:
            OutputError: another run is making files of the same names.
        """
        if self.folders:
            remove_leftovers(self._root, TEMPORARY)
            self._mark.enter_context(working_on(self._root, self.run.run_key))
        for folder, own in self.folders.items():
            remove_leftovers(folder, TEMPORARY)
            known = _manifest(folder).entries(self.run)
            there = {part.number for part in own if part.number in present}
            shards = []
            for part in self._every[folder]:
                shard = self._entry(part)
                if part.number in there:
                    old = known.get(shard.file)
                    same = old is not None and old.sha256 and old.bytes == part.file.stat().st_size
                    facts = old if same and old else listed(shard, part.file, 0)
                    update = {"rows": present[part.number], "bytes": facts.bytes, "sha256": facts.sha256}
                    shard = self._made[folder][shard.file] = shard.model_copy(update=update)
                shards.append(shard)
            run = self.run.model_copy(update={"shards": shards})
            making = {part.file.name for part in own if part.number not in there}
            busy = {w.run_key: w.host for w in workers(self._root) if w.run_key != run.run_key}
            update_manifest(folder, partial(Manifest.ask, run=run, making=making, busy=busy))

    def record(self, part: Part, rows: int, *, written: bool) -> None:
        """List a part that was made; ``written``: its file is on disk, else there was nothing to write."""
        if part.file.suffix != SUFFIX:
            return
        shard, time_ns = self._entry(part), _time(part.file)
        shard = listed(shard, part.file, rows) if written else shard.model_copy(update={"rows": 0})
        with self._lock:
            self._made[part.file.parent][shard.file] = shard
            self._unlisted[part.file.parent][shard.file] = shard, time_ns
        if self._seldom.again:
            self.flush()

    def remove(self, files: Sequence[Path]) -> None:
        """Remove files of a run that is replaced, all in one folder."""
        update_manifest(files[0].parent, partial(Manifest.drop, files={file.name for file in files}))
        for file in files:
            with writing(file):
                file.unlink(missing_ok=True)

    def flush(self) -> None:
        """Write what is not yet in the manifests; what is there another process may have made since."""
        with self._lock, self._seldom.noted():
            for folder, unlisted in self._unlisted.items():
                if unlisted:
                    made, asked = self._made[folder], map(self._entry, self._every[folder])
                    every = [made.get(shard.file, shard) for shard in asked]
                    update_manifest(folder, partial(_record, self.run, folder, every, list(unlisted.values())))
                    unlisted.clear()

    def close(self) -> None:
        """Say that this process is done; remove manifests without any file, and folders that were made for nothing."""
        self._mark.close()

        def forget(manifest: Manifest) -> None:
            if not any(shard.written for shard in manifest.shards) and not workers(self._root):
                manifest.runs = []

        for folder in self.folders:
            if not any(shard.sha256 for shard in self._made[folder].values()) and (folder / MANIFEST).exists():
                update_manifest(folder, forget)
        for folder in self._new if self.folders else ():
            with suppress(OSError):
                folder.rmdir()

    def _entry(self, part: Part) -> ListedShard:
        asked = part.rows if self._asks else None
        return ListedShard(file=part.file.name, shard_index=part.shard_index, asked=asked)


def _record(
    run: ListedRun,
    folder: Path,
    every: Sequence[ListedShard],
    shards: Sequence[tuple[ListedShard, int]],
    manifest: Manifest,
) -> None:
    """Take up files of a run; one that was replaced since its SHA-256 was made (its time is another) as it is now.

    Args:
        every: all that is asked of the run in the folder, in case that the manifest was removed.
    """
    if all(known.run_key != run.run_key for known in manifest.runs):
        others = {shard.file for known in manifest.runs if known.run_key for shard in known.shards}
        asked = [shard for shard in every if shard.file not in others]
        manifest.ask(run.model_copy(update={"shards": asked}), making=(), busy={})
    now = []
    for shard, time_ns in shards:
        changed = shard.sha256 and _time(folder / shard.file) not in (0, time_ns)
        now.append(listed(shard, folder / shard.file, shard.rows or 0) if changed else shard)
    manifest.record(run, now)


def _time(path: Path) -> int:
    """When a file was changed last [ns]; 0 if it is not there."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def entries(files: Iterable[Path]) -> dict[Path, ListedShard]:
    """What manifests say of files that lie in the folders of some."""
    folders = {file.parent for file in files}
    return {folder / shard.file: shard for folder in folders for shard in _manifest(folder).shards}


def begun_array(parts: Sequence[Part]) -> str:
    """The array of SLURM that began the run of some parts, as the manifest tells; "" if none did."""
    for part in parts[:1]:
        runs = _manifest(part.file.parent).runs
        return next((r.array for r in runs if any(s.file == part.file.name for s in r.shards)), None) or ""
    return ""


def _manifest(folder: Path) -> Manifest:
    """The manifest of a folder; an empty one where there is none, or a damaged one."""
    with suppress(ShardError):
        return read_manifest(folder / MANIFEST) or Manifest()
    return Manifest()


def _by_folder(parts: Sequence[Part]) -> dict[Path, list[Part]]:
    """Parts that manifests list, by their folders."""
    found: dict[Path, list[Part]] = defaultdict(list)
    for part in parts:
        if part.file.suffix == SUFFIX:
            found[part.file.parent].append(part)
    return found


class Renewing:
    """Entries of files that are replaced, in the folders that have a manifest."""

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts, self._lock = parts, threading.Lock()
        self._changing: set[Path] = set()
        self._changed: list[Path] = []
        self._seldom = _Seldom()

    @contextmanager
    def kept(self, present: Mapping[int, int]) -> "Iterator[Renewing]":
        """Keep the manifests while files are replaced: one that is going to be is listed without size and SHA-256 until
        some time after it is, so that a process may be killed at any moment.

        Args:
            present: rows of the parts that are made already, by number.

        Raises:
            OutputError: a folder cannot be written.
        """
        self._changing = {part.file for part in self._parts if part.number not in present}
        try:
            for folder in {part.file.parent for part in self._parts}:
                remove_leftovers(folder, TEMPORARY)
            _renew([part.file for part in self._parts if part.file not in self._changing])
            _renew(self._changing, changing=True)
            yield self
            self.flush()
        finally:
            self.close()

    def record(self, part: Part, rows: int, *, written: bool) -> None:
        """List a file as it is now."""
        with self._lock:
            self._changing.discard(part.file)
            self._changed.append(part.file)
        if self._seldom.again:
            self.flush()

    def flush(self) -> None:
        """Write what is not yet in the manifests."""
        with self._lock, self._seldom.noted():
            _renew(self._changed, changed=True)
            self._changed = []

    def close(self) -> None:
        """List all files as they are, those that were not replaced after all, too."""
        with suppress(OutputError):
            self.flush()
            with self._lock:
                left, self._changing = self._changing, set()
            _renew(left)


def _renew(files: Collection[Path], **how: bool) -> None:
    folders: dict[Path, list[Path]] = defaultdict(list)
    for file in files:
        folders[file.parent].append(file)
    for folder, these in folders.items():
        if (folder / MANIFEST).exists():
            update_manifest(folder, partial(Manifest.renew, files=these, **how))

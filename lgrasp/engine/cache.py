"""The content-keyed cache: arrays under SHA-256 keys, written whole or not at all; a damaged entry is a miss."""

import hashlib
import io
import json
import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from lgrasp.errors import CacheError, OutputError
from lgrasp.files import new_file, remove_leftovers
from lgrasp.paths import cache_dir
from lgrasp.runtime.kept import Keeper
from lgrasp.runtime.kernel_cache import remove_modules, remove_unfinished

if TYPE_CHECKING:
    import numpy as np

_FORMAT = 2
_NAMES = "/names"  # member that lists the others


def content_key(kind: str, version: int, **parts: Any) -> str:
    """Key of an artifact: SHA-256 of its kind, code version and everything it depends on (JSON-serialisable)."""
    return json_digest({"format": _FORMAT, "kind": kind, "version": version, **parts})


def json_digest(value: Any) -> str:
    """SHA-256 of a JSON-serialisable value, whatever the order of keys."""
    return hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class CacheEntry:
    """One file of the cache."""

    kind: str
    key: str
    path: Path
    size: int
    modified: float


class Cache:
    """Artifacts as ``<root>/<kind>/<key>.npz`` (uncompressed arrays with checksums).

    Args:
        root: the folder; the platform's user cache folder when None.
        warn: called with one line when an entry is damaged or the folder cannot be written.
        fresh: find only what this object stored itself, so that everything is rebuilt.
    """

    def __init__(
        self,
        root: str | os.PathLike[str] | None = None,
        warn: Callable[[str], None] | None = None,
        *,
        fresh: bool = False,
    ) -> None:
        self.root = cache_dir(root)
        self.fresh = fresh
        self._stored: set[Path] = set()
        self.kept = Keeper()
        """What jobs of this process share in memory."""
        self.more_jobs = False
        """Whether other jobs follow: processes that they may use are kept for them."""
        self.warn = warn or (lambda line: None)
        self._writable = True
        if os.path.exists(self.root) and not os.path.isdir(self.root):
            raise CacheError(f"cache folder {self.root} is a file; name a folder with --cache-dir or LGRASP_CACHE_DIR")

    def path(self, kind: str, key: str) -> Path:
        """File of an artifact, whether it exists or not."""
        return self.root / kind / f"{key}.npz"

    def has(self, kind: str, key: str) -> bool:
        """True if there is an entry. (It may still prove damaged on loading.)"""
        path = self.path(kind, key)
        return os.path.isfile(path) and (not self.fresh or path in self._stored)

    def load(self, kind: str, key: str) -> "dict[str, np.ndarray] | None":
        """Arrays of an artifact, or None if it is absent or damaged (which is reported)."""
        path = self.path(kind, key)
        if not self.has(kind, key):
            return None
        try:
            data = path.read_bytes()
        except FileNotFoundError:
            return None
        except OSError as error:
            self.warn(f"cache entry {path} cannot be read ({error.strerror}); rebuilding it")
            return None
        try:
            try:
                arrays = _unpack(data)
            except SystemError:  # CPython before 3.11.8 and 3.12.2, where threads parse at the same time (gh-106905)
                arrays = _unpack(data)
            if json.loads(str(arrays.pop(_NAMES))) != sorted(arrays):  # checksums cover members, not their list
                raise ValueError("members are missing")
            return arrays
        except Exception:  # damaged bytes make the readers of zip and npy raise almost anything
            self.warn(f"cache entry {path} is damaged; rebuilding it")
            return None

    def store(self, kind: str, key: str, arrays: "dict[str, np.ndarray]") -> None:
        """Write an artifact: unique temporary name, fsync, rename.

        A folder that cannot be written is reported once and is not an error; nothing more is stored then.
        """
        if not self._writable:
            return
        import numpy as np

        path = self.path(kind, key)
        try:
            with new_file(path) as file:
                buffer = io.BufferedWriter(file)
                np.savez(buffer, allow_pickle=False, **arrays | {_NAMES: np.asarray(json.dumps(sorted(arrays)))})
                buffer.detach()
            self._stored.add(path)
        except OutputError as error:
            self._writable = False
            reason = getattr(error.__cause__, "strerror", error)
            self.warn(f"cache folder {self.root} cannot be written ({reason}); going on without it")

    def discard(self, kind: str, key: str) -> None:
        """Remove an artifact that is needed no more, if it is there."""
        with suppress(OSError):
            self.path(kind, key).unlink()

    def get(
        self, kind: str, key: str, make: "Callable[[], dict[str, np.ndarray]]"
    ) -> "tuple[dict[str, np.ndarray], bool]":
        """The artifact and whether it was a hit; a miss is made and stored."""
        arrays = self.load(kind, key)
        if arrays is not None:
            return arrays, True
        arrays = make()
        self.store(kind, key, arrays)
        return arrays, False

    def entries(self) -> list[CacheEntry]:
        """Every artifact, largest first."""
        found = []
        for path in self.root.glob("*/*.npz"):
            try:
                info = path.stat()
            except FileNotFoundError:
                continue
            found.append(CacheEntry(path.parent.name, path.stem, path, info.st_size, info.st_mtime))
        return sorted(found, key=lambda e: -e.size)

    def prune(self, kinds: set[str] | None = None, older_than: float | None = None) -> tuple[int, int]:
        """Remove artifacts (of some kinds, last written before a time [s since 1970]); returns (files, bytes)."""
        old = [e for e in self.entries() if older_than is None or e.modified < older_than]
        found = [(entry.path, entry.size) for entry in old if kinds is None or entry.kind in kinds]
        variants = [*(self.root / "variants").glob("*/")] if kinds is None else []
        variants = [folder for folder in variants if older_than is None or folder.stat().st_mtime < older_than]
        inside = (path for folder in variants for path in folder.rglob("*") if path.is_file())
        found += [(path, path.stat().st_size) for path in inside]
        gone, kept = [], []
        for path, size in found:
            try:
                path.unlink(missing_ok=True)
                gone.append(size)
            except OSError as error:
                kept.append(f"{path}: {error.strerror}")
        for folder in variants:
            shutil.rmtree(folder, ignore_errors=True)
        remove_leftovers(self.root, "*/*.tmp")
        for folder in (self.root / "kernels").glob("*/"):
            remove_unfinished(folder)
        if kept:
            self.warn(f"{len(kept):,} that this user cannot remove stay, first {kept[0]}")
        return len(gone), sum(gone)

    def kernel_bytes(self) -> int:
        """Size of the compiled kernels, which Warp keeps in a folder of this one."""
        return sum(path.stat().st_size for path in (self.root / "kernels").rglob("*") if path.is_file())

    def prune_kernels(self, older_than: float | None = None) -> int:
        """Remove the compiled kernels, of before a time [s since 1970]; returns their size [bytes]."""
        return remove_modules(self.root / "kernels", older_than)


def _unpack(data: bytes) -> "dict[str, np.ndarray]":
    import numpy as np  # slow to load, and not needed to list

    with np.load(io.BytesIO(data), allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}

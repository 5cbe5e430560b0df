"""Whole-or-absent output files, which files are shards, and guards against damage that HDF5 does not notice."""

import errno
import hashlib
import io
import mmap
import os
import platform
import re
import time
import uuid
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from struct import unpack_from
from typing import IO

import h5py

from lgrasp.errors import OutputError, ShardError

try:
    import fcntl
except ImportError:  # Windows: leftovers cannot be distinguished from files being written
    fcntl = None

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
"""Shard files, or folders of them."""

_TEMPORARY = re.compile(r"\.([0-9a-f]{6})[0-9a-f]{6}-[0-9a-f]{12}\b")  # the computer in a temporary file's name
_FOREIGN_AGE = 86_400.0  # [s]
_LIBVER = ("v110", "v110")  # readable since HDF5 1.10; its metadata blocks carry checksums, the older layout's do not


class _Sink(io.FileIO):
    """Binary file for HDF5 that remembers the first write error instead of raising it.

    The HDF5 library aborts the process when a write fails while it closes a file (disk full). Here it sees every
    write succeed, closes in peace, and :func:`new_shard_file` reports the error afterwards.
    """

    error: OSError | None = None

    def readinto(self, buffer) -> int:
        n = super().readinto(buffer) or 0
        buffer[n:] = bytes(len(buffer) - n)  # only short after a failed write
        return len(buffer)

    def write(self, data) -> int:
        view = memoryview(data).cast("B")
        done = 0
        while done < len(view) and self.error is None:
            try:
                done += super().write(view[done:]) or 0
            except OSError as error:
                self.error = error
        return len(view)

    def truncate(self, size: int | None = None) -> int:
        if self.error is None:
            try:
                super().truncate(size)
            except OSError as error:
                self.error = error
        return size or 0


@contextmanager
def new_file(path: str | os.PathLike[str], *, flush: bool = True) -> Iterator:
    """A binary file that appears under its name only when the block ends without an error.

    The bytes go to a unique ``*.tmp`` in the same folder, which is fsynced and renamed; then the folder is fsynced.
    Without ``flush`` nothing is fsynced, which takes longer than all the rest where files are many and small.
    Missing parent folders are made. On any error the temporary file is removed; what a killed process leaves is taken
    away by :func:`remove_leftovers`.

    Raises:
        OutputError: The folder cannot be written or is full.
    """
    path = Path(path)
    temporary = path.with_name(f"{path.stem}.{_machine()}-{uuid.uuid4().hex[:12]}{path.suffix}.tmp")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _held_file(temporary) as file:
            yield file
            file.flush()
            if flush:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if flush:
            _sync_folder(path.parent)
    except OSError as error:
        if error.errno is None:  # not the operating system's: a reader's complaint passing through
            raise
        hint = " (free some space or choose another folder)" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        raise OutputError(f"cannot write {path}: {error.strerror or error}{hint}") from error
    finally:
        with suppress(OSError):
            temporary.unlink()


def write_file(path: str | os.PathLike[str], data: bytes | str, *, flush: bool = True) -> None:
    """Write a whole file; text is UTF-8. Arguments and errors as of :func:`new_file`."""
    with new_file(path, flush=flush) as file:
        file.write(data.encode() if isinstance(data, str) else data)


@contextmanager
def new_shard_file(path: str | os.PathLike[str]) -> Iterator[h5py.File]:
    """An empty HDF5 file, open for writing, that appears as ``path`` only when the block ends without an error.

    Raises:
        OutputError: As :func:`new_file`.
    """
    with new_file(path) as raw:
        sink = _Sink(raw.fileno(), "r+", closefd=False)
        with h5py.File(sink, "w", libver=_LIBVER) as file:
            yield file
        if sink.error is not None:
            raise sink.error


@contextmanager
def _held_file(path: Path) -> Iterator[IO[bytes]]:
    """A new file, open and locked until it is closed or its process ends in any way."""
    while True:
        with open(path, "x+b") as file:
            if fcntl:
                with suppress(OSError):  # a file system without locks
                    fcntl.flock(file.fileno(), fcntl.LOCK_EX)
            if path.exists():  # else it was taken for a leftover between the two calls
                yield file
                return


@cache
def _machine() -> str:
    """Digits of this computer and of its last start, which tell whose a temporary file is."""
    try:
        start = Path("/proc/sys/kernel/random/boot_id").read_text()
    except OSError:
        start = ""
    return "".join(hashlib.sha256(text.encode()).hexdigest()[:6] for text in (platform.node(), start))


def remove_leftovers(folder: Path, pattern: str) -> None:
    """Remove the temporary files that match a glob pattern and that no living process writes.

    A lock tells of processes on this computer only (network file systems need not share locks); files of other
    computers stay for a day.
    """
    if not fcntl:
        return
    for path in folder.glob(pattern):
        with suppress(OSError), open(path, "rb") as file:  # gone already, held, or not ours to remove
            written = _TEMPORARY.search(path.name)
            if written and written[1] != _machine()[:6] and time.time() - path.stat().st_mtime < _FOREIGN_AGE:
                continue
            fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
            path.unlink()


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def parsing(path: str | os.PathLike[str], what: str = "", kinds: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn an error of the system, or one of some kinds that say that a file is not what it should be, into a
    ShardError that names the file."""
    try:
        yield
    except OSError as error:
        raise ShardError(f"{error.filename or path}: {error.strerror or error}") from error
    except kinds as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ShardError(f"{path}: not {what}: {reason}") from error


def find_shards(paths: Paths) -> list[Path]:
    """The shard files named by paths: a folder stands for its ``*.h5`` files, sorted by name, not recursive.

    Raises:
        ShardError: A path does not exist, or no shard is left.
    """
    return [file for file, _ in _found(paths, "*.h5")]


def shard_tree(paths: Paths, *, leave_out: Path | None = None) -> dict[Path, Path]:
    """Shard files by their place below the folder that was named, sorted; a file's place is its own name.

    Args:
        paths: Shard files, or folders whose ``*.h5`` files at any depth are meant.
        leave_out: Folder that is not looked into.

    Raises:
        ShardError: A path does not exist, no shard is left, or two of them have one place.
    """
    found: dict[Path, Path] = {}
    for file, folder in _found(paths, "**/*.h5", leave_out):
        place = file.relative_to(folder)
        if place in found and not found[place].samefile(file):
            raise ShardError(f"{file}: it has the same place {place} as {found[place]}; name one folder above both")
        found[place] = file
    return found


def _found(paths: Paths, pattern: str, leave_out: Path | None = None) -> list[tuple[Path, Path]]:
    """Shard files with the folders that were named; with its own for a file that was named."""
    given = [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(p) for p in paths]
    found: list[tuple[Path, Path]] = []
    for path in given:
        if not path.exists():
            raise ShardError(f"{path}: no such file or folder")
        found += [(file, path) for file in sorted(path.glob(pattern))] if path.is_dir() else [(path, path.parent)]
    if leave_out is not None:
        found = [(file, top) for file, top in found if not file.resolve().is_relative_to(leave_out.resolve())]
    if not found:
        raise ShardError(f"no shard (*.h5) in {', '.join(map(str, given)) or 'an empty list of paths'}")
    return found


_SIGNATURE = b"GCOL\x01\x00\x00\x00"
_HEADER = 16  # bytes, of a collection and of each entry


def check_heaps(path: str | os.PathLike[str]) -> None:
    """Walk through every string heap of an HDF5 file; reads the whole file once.

    Attributes and the URDF are strings of variable length, which HDF5 keeps in "global heap collections" without
    checksums: a flipped bit in the size of an entry can make the library loop for ever instead of reporting an error.

    Raises:
        ShardError: The file cannot be read, or an entry of a heap does not fit.
    """
    with parsing(path), open(path, "rb") as file:
        if os.fstat(file.fileno()).st_size == 0:
            return  # opening it reports this better
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            start = data.find(_SIGNATURE)
            while start >= 0:
                if not _is_sound(data, start):
                    raise ShardError(f"{path}: cannot be read, it is damaged: string heap at byte {start}")
                start = data.find(_SIGNATURE, start + _HEADER)


def _is_sound(data: mmap.mmap, start: int) -> bool:
    if start + _HEADER > len(data):
        return False
    (size,) = unpack_from("<Q", data, start + 8)
    end = start + size
    if end > len(data):
        return False
    entry = start + _HEADER
    while entry + _HEADER <= end:
        index, length = unpack_from("<H6xQ", data, entry)
        if index == 0:  # the free space, which is the rest and counts its own header
            return entry + length == end
        entry += _HEADER + (length + 7) // 8 * 8
    return entry <= end

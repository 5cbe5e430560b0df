"""Files and folders that are whole or absent, temporary ones, and what killed processes left of them."""

import atexit
import errno
import glob
import hashlib
import os
import platform
import re
import shutil
import tempfile
import time
import uuid
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import IO

from lgrasp.errors import OutputError

try:
    import fcntl
except ImportError:  # Windows: leftovers cannot be distinguished from files being written
    fcntl = None

_LONGEST_NAME = 255  # bytes, of a file
_TEMPORARY = re.compile(r"\.([0-9a-f]{6})[0-9a-f]{6}-[0-9a-f]{12}\b")  # the computer in a temporary file's name
FOREIGN_AGE = 86_400.0
"""Seconds after which temporary files of other computers are left over."""
_last: list[Callable[[], None]] = []
_held: dict[Path, int] = {}  # temporary files and folders of this process, with the descriptors that lock them


@contextmanager
def new_file(path: str | os.PathLike[str], *, flush: bool = True) -> Iterator[IO[bytes]]:
    """A binary file that appears under its name only when the block ends without an error.

    The bytes go to a unique ``*.tmp`` in the same folder, which is fsynced and renamed; then the folder is fsynced, and
    what killed processes left of the same file is removed. Without ``flush`` none of this is done, which takes longer
    than all the rest where files are many and small. Missing parent folders are made. A link stays: what it leads to is
    replaced. On any error the temporary file is removed.

    Raises:
        OutputError: The folder cannot be written or is full.
    """
    path = Path(os.path.realpath(path) if os.path.islink(path) else path)
    with writing(path):
        temporary = hold_file(path)
        try:
            with open(_held[temporary], "r+b", closefd=False) as file:
                yield file
                file.flush()
                if flush:
                    _sync(file.fileno())
            os.replace(temporary, path)
        finally:
            _discard(temporary)
        if flush:
            _sync_folder(path.parent)
            _remove_left(path)


def write_file(path: str | os.PathLike[str], data: bytes | str, *, flush: bool = True) -> None:
    """Write a whole file; text is UTF-8. Arguments and errors as of :func:`new_file`.

    A pipe or device such as /dev/stdout is written to, not replaced by a file.
    """
    data = data.encode() if isinstance(data, str) else data
    if is_special(Path(path)):
        with writing(Path(path)), open(path, "wb") as file:
            file.write(data)
        return
    with new_file(path, flush=flush) as file:
        file.write(data)


def is_special(path: Path) -> bool:
    """Something that exists and is no regular file: it must not be replaced by one."""
    return path.exists() and not path.is_file()


@contextmanager
def new_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """An empty folder that appears under its name only when the block ends without an error, in place of the one that
    is there; otherwise as :func:`new_file`.

    Raises:
        OutputError: The parent folder cannot be written or is full.
    """
    path = Path(path)
    with writing(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary, old = _hold(path, _make_folder), _unique(path)
    try:
        yield temporary
        with writing(path):
            if os.path.lexists(path):
                os.replace(path, old)
            os.replace(temporary, path)
    finally:
        _discard(temporary)
    _remove_left(path)  # the old one, too


def scratch_folder() -> Path:
    """A temporary folder that goes when the process ends; what killed processes left of theirs goes now."""
    path = Path(tempfile.gettempdir()) / "lgrasp"
    _remove_left(path)
    return _hold(path, lambda name: _make_folder(name, 0o700))


@contextmanager
def temporary_folder() -> Iterator[Path]:
    """As :func:`scratch_folder`, for a block."""
    folder = scratch_folder()
    try:
        yield folder
    finally:
        _discard(folder)


def hold_file(path: Path) -> Path:
    """A new temporary file beside a path that is there until this process ends; see :func:`is_held`. Missing parent
    folders are made.

    Raises:
        OSError: The folder cannot be written.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    return _hold(path, lambda name: os.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL, 0o666))


@contextmanager
def held_file(path: str | os.PathLike[str], data: bytes) -> Iterator[None]:
    """A temporary file that is there while the block runs: it says that a process lives, see :func:`is_held`.

    Named, and taken away if the process is killed, as the temporary files of :func:`new_file`.

    Raises:
        OutputError: The folder cannot be written or is full.
    """
    path = Path(path)
    with writing(path):
        temporary = hold_file(path)
    try:
        with writing(path):
            os.write(_held[temporary], data)
        yield
    finally:
        _discard(temporary)


def at_end(action: Callable[[], None]) -> None:
    """Call ``action`` when this process ends, by :func:`discard_temporaries` if it is ended."""
    _last.append(action)


@contextmanager
def before_end(action: Callable[[], None]) -> Iterator[None]:
    """As :func:`at_end`, if the process ends inside the block."""
    at_end(action)
    try:
        yield
    finally:
        _last.remove(action)


def leave_behind(path: Path) -> None:
    """Leave a temporary file to :func:`remove_leftovers` of the next process."""
    _held.pop(path, None)


@atexit.register
def discard_temporaries() -> None:
    """Remove all temporary files and folders of this process, which is about to end.

    Other threads may still write into them: descriptors stay open.
    """
    for action in list(_last):
        with suppress(Exception):
            action()
    while _held:
        with suppress(OSError):
            _remove(_held.popitem()[0])


os.register_at_fork(after_in_child=lambda: (_held.clear(), _last.clear()))  # they are the parent's


def is_held(path: Path) -> bool:
    """True if a living process has a temporary file open, as far as locks tell."""
    with suppress(OSError), open(path, "rb") as file:
        if fcntl:
            try:
                fcntl.flock(file.fileno(), fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return True
    return False


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Hold the lock of the file of some name, which the block may replace or remove; without one, make an empty file.

    Raises:
        OutputError: The folder cannot be written.
    """
    while True:
        with ExitStack() as stack:
            with writing(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                try:
                    file = stack.enter_context(open(path, "ab"))
                except PermissionError:  # another user's: its lock is enough
                    file = stack.enter_context(open(path, "rb"))
            if fcntl:
                with suppress(OSError):  # a file system without locks
                    fcntl.flock(file.fileno(), fcntl.LOCK_EX)
            with writing(path):
                named = _is_named(file, path)
            if named:  # else it was replaced or removed between the two calls
                yield
                return


def _is_named(file: IO[bytes], path: Path) -> bool:
    """True if a path leads to an open file; opened once more, since network file systems then look again."""
    try:
        with open(path, "rb") as now:
            return os.path.samestat(os.fstat(file.fileno()), os.fstat(now.fileno()))
    except FileNotFoundError:
        return False


def remove_leftovers(folder: Path, pattern: str) -> list[Path]:
    """Remove the temporary files and folders that match a glob pattern and that no living process holds.

    A lock tells of processes on this computer only (network file systems need not share locks); those of other
    computers stay for a day.

    Returns:
        What was removed.
    """
    removed: list[Path] = []
    if not fcntl:
        return removed
    for path in folder.glob(pattern):
        with suppress(OSError):  # gone already, held, or not ours to remove
            written = _TEMPORARY.search(path.name)
            if written and written[1] != _machine()[:6] and time.time() - path.stat().st_mtime < FOREIGN_AGE:
                continue
            mode = os.O_RDONLY if path.is_dir() else os.O_RDWR  # which locks of network file systems need
            descriptor = os.open(path, mode | os.O_NOFOLLOW | os.O_NONBLOCK)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                _remove(path)
                removed.append(path)
            finally:
                os.close(descriptor)
    return removed


def _remove_left(path: Path) -> None:
    """Remove what killed processes left of a file or folder."""
    tag = f"{12 * '?'}-{12 * '?'}"
    remove_leftovers(path.parent, f"{glob.escape(_short_stem(path))}.{tag}{glob.escape(path.suffix)}.tmp")


def _short_stem(path: Path) -> str:
    """The name of a file without its suffix, cut so that its temporary names are no longer than a name may be."""
    stem, most = path.stem, _LONGEST_NAME - len(os.fsencode(f".{12 * '-'}-{12 * '-'}{path.suffix}.tmp"))
    while len(os.fsencode(stem)) > most > 0:
        stem = stem[:-1]
    return stem


def _unique(path: Path) -> Path:
    """Name of a temporary file or folder beside a path."""
    return path.with_name(f"{_short_stem(path)}.{_machine()}-{uuid.uuid4().hex[:12]}{path.suffix}.tmp")


def _hold(path: Path, make: Callable[[Path], int | None]) -> Path:
    """A new temporary file or folder beside a path, locked until it is discarded or its process ends in any way;
    ``make`` gives a descriptor of it, or None if it is gone already."""
    while True:
        temporary = _unique(path)
        descriptor = make(temporary)
        if descriptor is None:
            continue
        if fcntl:
            with suppress(OSError):  # a file system without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX)
        if temporary.exists():  # else it was taken for a leftover between the two calls
            _held[temporary] = descriptor
            return temporary
        os.close(descriptor)


def _make_folder(path: Path, mode: int = 0o777) -> int | None:
    """Make a folder and open it; None if another process took it for a leftover between the two calls."""
    path.mkdir(mode)
    with suppress(FileNotFoundError):
        return os.open(path, os.O_RDONLY)
    return None


def _discard(path: Path) -> None:
    """Remove a temporary file or folder of this process, if it is still there."""
    descriptor = _held.pop(path, None)
    if descriptor is not None:
        with suppress(OSError):
            _remove(path)
        os.close(descriptor)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn errors of the operating system into one that names the file."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # not the operating system's: a reader's complaint passing through
            raise
        hint = " (free some space or choose another folder)" if error.errno in (errno.ENOSPC, errno.EDQUOT) else ""
        raise OutputError(f"cannot write {path}: {error.strerror or error}{hint}") from error


@cache
def _machine() -> str:
    """Digits of this computer and of its last start, which tell whose a temporary file is."""
    try:
        start = Path("/proc/sys/kernel/random/boot_id").read_text()
    except OSError:
        start = ""
    return "".join(hashlib.sha256(text.encode()).hexdigest()[:6] for text in (platform.node(), start))


def _sync(descriptor: int) -> None:
    """Have the disk keep what was written; macOS leaves it in the disk's memory unless asked otherwise."""
    if hasattr(fcntl, "F_FULLFSYNC"):
        with suppress(OSError):  # a disk that cannot
            fcntl.fcntl(descriptor, fcntl.F_FULLFSYNC)
            return
    os.fsync(descriptor)


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        _sync(descriptor)
    finally:
        os.close(descriptor)

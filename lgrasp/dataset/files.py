"""Which files are shards, and guards against damage that HDF5 does not notice.

Light to import: a file or folder that is not there is told at once.
"""

import hashlib
import mmap
import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from struct import unpack_from

from lgrasp.errors import ShardError, short_reason
from lgrasp.notices import notice
from lgrasp.paths import is_litter

Paths = str | os.PathLike[str] | Iterable[str | os.PathLike[str]]
"""Shard files, or folders of them."""


@contextmanager
def parsing(path: str | os.PathLike[str], what: str = "", kinds: tuple[type[Exception], ...] = ()) -> Iterator[None]:
    """Turn an error of the system, or one of some kinds that say that a file is not what it should be, into a
    ShardError that names the file."""
    try:
        yield
    except OSError as error:
        raise ShardError(f"{error.filename or path}: {error.strerror or error}") from error
    except kinds as error:
        reason = f"it has no {error}" if isinstance(error, KeyError) else short_reason(error)
        raise ShardError(f"{path}: not {what}: {reason}") from error


def check_regular(path: str | os.PathLike[str]) -> None:
    """Refuse a pipe or device, which would be waited for.

    Raises:
        ShardError: It is there, and is a pipe, a device or a folder.
    """
    if os.path.exists(path) and not os.path.isfile(path):
        raise ShardError(f"{path}: no regular file")


def sha256(path: str | os.PathLike[str]) -> str:
    """SHA-256 of a file, in hexadecimal digits.

    Raises:
        ShardError: It cannot be read.
    """
    check_regular(path)
    with parsing(path), open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def find_shards(paths: Paths, what: str = "shard") -> list[Path]:
    """The shard files named by paths: a folder stands for its ``*.h5`` files, sorted by name, not recursive.

    Args:
        what: They are, ``shard`` or ``scene``.

    Raises:
        ShardError: A path does not exist, or no shard is left.
    """
    try:
        return [file for file, _ in _found(paths, deep=False, what=what)]
    except ShardError as error:
        below = folders_below(paths) if what == "shard" else []  # those below scenes hold their grasps
        holding = [folder for folder in below if files_in(folder)]
        raise ShardError(f"{error}; name one of its folders, such as {holding[0]}") if holding else error from None


def shards_below(paths: Paths, leave_out: Path | None = None) -> list[tuple[Path, Path]]:
    """Shard files of folders of any depth, sorted, each with the folder that was named; with its own for a file that
    was named. A file that is given twice is there once.

    Args:
        leave_out: Folder that is not looked into.

    Raises:
        ShardError: A path does not exist, or no shard is left.
    """
    return list({file.absolute(): (file, folder) for file, folder in _found(paths, leave_out)}.values())


def folders_below(paths: Paths, *, deep: bool = True) -> list[Path]:
    """The folders among some paths, and, of any depth, those below them that hold shards."""
    tops = [path for path in given_paths(paths) if path.is_dir()]
    return list(dict.fromkeys(f for t in tops for f in (t, *sorted({s.parent for s in files_in(t, deep=deep)}))))


def walk(
    top: Path, *, hidden: bool = True, unread: Callable[[OSError], None] | None = None
) -> Iterator[tuple[Path, list[str]]]:
    """A folder and those below it, each once, with the names of their files. Links to folders elsewhere are followed.

    Args:
        hidden: also those whose names begin with a dot.
        unread: given why a folder cannot be read, which is told as a notice by default.
    """
    real, seen = top.resolve(), set()

    def is_new(folder: Path) -> bool:
        target = folder.resolve()
        return not os.path.islink(folder) or not (target.is_relative_to(real) or real.is_relative_to(target))

    for name, below, files in os.walk(top, onerror=unread or _left_out, followlinks=True):
        here = Path(name)
        if (place := here.resolve()) in seen:
            below.clear()
            continue
        seen.add(place)
        below[:] = sorted(f for f in below if (hidden or not f.startswith(".")) and is_new(here / f))
        yield here, files


def _left_out(error: OSError) -> None:
    notice(f"folder {error.filename} is left out: {error.strerror}")


def unread_folders(paths: Paths) -> dict[str, str]:
    """Why folders among some paths or below them cannot be read, by name."""
    found: list[OSError] = []
    for top in given_paths(paths):
        for _ in walk(top, unread=found.append) if top.is_dir() else ():
            pass
    return {str(error.filename): error.strerror or "" for error in found}


def files_in(folder: Path, *, deep: bool = False) -> list[Path]:
    """The ``*.h5`` files in a folder, sorted; ``deep``: also in those below it."""
    found = (here / name for here, names in walk(folder) for name in names) if deep else folder.glob("*.h5")
    return sorted(path for path in found if path.suffix == ".h5" and not is_litter(path.name))


def named_files(paths: Paths) -> list[Path]:
    """Those of some paths that are no folders."""
    return [path for path in given_paths(paths) if not path.is_dir()]


def places(paths: Iterable[Path]) -> list[str]:
    """The names of files; below their common folder if they lie in several."""
    files = [path.absolute() for path in paths]
    top = os.path.commonpath([file.parent for file in files])
    return [str(file.relative_to(top)) for file in files]


def given_paths(paths: Paths) -> list[Path]:
    """One path or several as a list."""
    return [Path(paths)] if isinstance(paths, str | os.PathLike) else [Path(p) for p in paths]


def _found(
    paths: Paths, leave_out: Path | None = None, *, deep: bool = True, what: str = "shard"
) -> list[tuple[Path, Path]]:
    """Shard files with the folders that were named; with its own for a file that was named."""
    given = given_paths(paths)
    found: list[tuple[Path, Path]] = []
    for path in given:
        if not path.exists():
            raise ShardError(f"{path}: no such file or folder")
        if not path.is_dir():
            check_regular(path)
        found += [(file, path) for file in files_in(path, deep=deep)] if path.is_dir() else [(path, path.parent)]
    if leave_out is not None:
        found = [(file, top) for file, top in found if not file.resolve().is_relative_to(leave_out.resolve())]
    if not found:
        raise ShardError(f"no {what} (*.h5) in {', '.join(map(str, given)) or 'an empty list of paths'}")
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
    check_regular(path)
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

"""A look at the string heaps of an HDF5 file before HDF5 reads them: a damaged size there makes it loop for ever."""

import mmap
from pathlib import Path
from struct import unpack_from

from lgrasp.judge.bounds import JudgeError

_SIGNATURE = b"GCOL\x01\x00\x00\x00"


def check_strings(path: Path) -> None:
    """Walk through the entries of every global heap.

    Raises:
        JudgeError: no such file, an empty one, or an entry that does not fit.
    """
    try:
        with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            heap = data.find(_SIGNATURE)
            while heap >= 0:
                if not _fits(data, heap):
                    raise JudgeError(f"{path}: damaged: string heap at byte {heap}")
                heap = data.find(_SIGNATURE, heap + 16)
    except ValueError as error:
        raise JudgeError(f"{path}: empty") from error
    except OSError as error:
        raise JudgeError(f"{path}: {error.strerror or error}") from error


def _fits(data: mmap.mmap, heap: int) -> bool:
    """Entries (index, count, size, bytes padded to 8) fill a heap up to free space, which is entry 0."""
    if heap + 16 > len(data):
        return False
    end = heap + unpack_from("<Q", data, heap + 8)[0]
    at = heap + 16
    while at + 16 <= end <= len(data):
        index, size = unpack_from("<H6xQ", data, at)
        if index == 0:
            return at + size == end
        at += 16 + -(-size // 8) * 8
    return at <= end <= len(data)

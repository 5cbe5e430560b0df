"""Guards against damage in HDF5's string heaps, which the library neither checksums nor reads safely.

Attributes and the URDF are strings of variable length. HDF5 keeps them in "global heap collections", and a flipped bit
in the size of an entry can make the library loop for ever instead of reporting an error.
"""

import mmap
import os
from struct import unpack_from

from lgrasp.errors import ShardError

_SIGNATURE = b"GCOL\x01\x00\x00\x00"
_HEADER = 16  # bytes, of a collection and of each entry


def check_heaps(path: str | os.PathLike[str]) -> None:
    """Walk through every string heap of an HDF5 file; reads the whole file once.

    Raises:
        ShardError: The file cannot be read, or an entry of a heap does not fit.
    """
    try:
        with open(path, "rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return  # opening it reports this better
            with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
                start = data.find(_SIGNATURE)
                while start >= 0:
                    if not _is_sound(data, start):
                        raise ShardError(f"{path}: cannot be read, it is damaged: string heap at byte {start}")
                    start = data.find(_SIGNATURE, start + _HEADER)
    except OSError as error:
        raise ShardError(f"{path}: {error.strerror or error}") from error


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

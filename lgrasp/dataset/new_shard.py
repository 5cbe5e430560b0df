"""HDF5 files that are whole or absent, on full disks too."""

import io
import os
from collections.abc import Iterator
from contextlib import contextmanager

import h5py

from lgrasp.files import new_file

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

"""Kernels of the processor that the processes of one test run compile once, not each of them all."""

import fcntl
from pathlib import Path

import warp as wp

from lgrasp.runtime.kernel_cache import note_checksums
from lgrasp.runtime.kernels import kernel_modules


def kernel_folder() -> Path:
    """Where kernels are, as a ``WARP_CACHE_PATH`` of other processes: Warp adds its version."""
    return Path(wp.config.kernel_cache_dir).parent


def compile_together(folder: Path, *, backwards: bool) -> None:
    """Compile the kernels of all imported modules that no other process compiles; wait for those that one does.

    In this thread: the headers that it compiles, seconds of work, are there for the kernels of tests.

    Args:
        folder: the same for all processes of a run.
        backwards: begin with the last; processes that begin at different ends meet late.
    """
    names = kernel_modules()
    for wait in (False, True):
        for name in reversed(names) if backwards else names:
            with open(folder / f"{name}.compiled", "ab") as file:
                try:
                    fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
                except BlockingIOError:
                    continue
                if not file.tell():
                    wp.load_module(name, "cpu")
                    file.write(b"done")
    note_checksums(Path(wp.config.kernel_cache_dir))

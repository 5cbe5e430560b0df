"""Kernels of the processor that the processes of one test run compile once, not each of them all."""

import fcntl
from pathlib import Path

from lgrasp.runtime.kernels import kernel_modules, load_kernels


def compile_together(folder: Path, *, backwards: bool) -> None:
    """Compile the kernels of all imported modules that no other process compiles; wait for those that one does.

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
                    load_kernels("cpu", [name])
                    file.write(b"done")

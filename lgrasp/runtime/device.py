"""Starts Warp quietly, keeps its kernels in our cache and resolves device names."""

import atexit
import contextlib
import ctypes
import os
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import warp as wp

from lgrasp.errors import DeviceError
from lgrasp.paths import cache_dir
from lgrasp.runtime.cores import cores
from lgrasp.runtime.driver import has_driver
from lgrasp.runtime.kernel_cache import drop_damaged, enter, note_checksums, usable_folder

KERNEL_OPTIONS = {"enable_backward": False, "max_unroll": 1}
"""Module options of every non-differentiable kernel module (they decide compile time: minutes or seconds)."""

_started_in = 0  # number of the process that started Warp: this one, or one that it was forked from


@dataclass(frozen=True)
class Device:
    """A resolved compute device."""

    alias: str
    """Warp's name of it: ``cpu`` or ``cuda:N``."""
    name: str
    """The product's name, for reports."""

    @property
    def is_cuda(self) -> bool:
        return self.alias.startswith("cuda")


def start() -> None:
    """Initialise Warp once, without output; compiled kernels go to ``<cache>/kernels``, or where that cannot be written
    to a temporary folder. Damaged ones are dropped.

    A ``WARP_CACHE_PATH`` set by the user wins.
    """
    global _started_in
    if _started_in:
        return
    wp.config.log_level = wp.LOG_ERROR
    wanted = os.environ.get("WARP_CACHE_PATH") or cache_dir() / "kernels"
    wp.config.kernel_cache_dir = str(usable_folder(Path(wanted)))
    _share_memory()
    with _without_driver_warning():
        wp.init()
    folder = Path(wp.config.kernel_cache_dir)  # Warp added its version
    enter(folder)
    drop_damaged(folder)
    atexit.register(note_checksums, folder)
    _started_in = os.getpid()


def _share_memory() -> None:
    """Have threads of the C library's allocator share memory: else what batches free in one place stays unused for all
    others, and a process grows by megabytes a shard. A ``MALLOC_ARENA_MAX`` set by the user wins."""
    if "MALLOC_ARENA_MAX" not in os.environ:
        with contextlib.suppress(OSError, AttributeError):  # another C library
            ctypes.CDLL(None).mallopt(-8, cores())  # M_ARENA_MAX; 8 a core by default


def _without_threads() -> None:
    """A forked process has none of the threads that torch started before, and would wait for them for ever."""
    if "torch" in sys.modules:
        sys.modules["torch"].set_num_threads(1)


os.register_at_fork(after_in_child=_without_threads)


@contextlib.contextmanager
def _without_driver_warning() -> Iterator[None]:
    """Without a GPU driver, drop the line that Warp's native code writes on stderr about it; other output is kept."""
    if has_driver():
        yield
        return
    try:
        stderr = os.dup(2)
    except OSError:  # closed: nobody sees the warning
        yield
        return
    with tempfile.TemporaryFile() as caught:
        os.dup2(caught.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(stderr, 2)
            os.close(stderr)
            caught.seek(0)
            kept = [line for line in caught if b"CUDA driver" not in line]
            with contextlib.suppress(OSError):
                os.write(2, b"".join(kept))


def resolve_device(name: str = "auto") -> Device:
    """Turn ``auto``, ``cpu``, ``cuda`` or ``cuda:N`` into a device that exists.

    Raises:
        DeviceError: the name is unknown or the GPU is absent (the message lists what exists), or it is a GPU and this a
            process forked from one that has started Warp.
    """
    start()
    present = ["cpu", *(f"cuda:{i}" for i in range(wp.get_cuda_device_count()))]
    alias = {"auto": present[min(1, len(present) - 1)], "cuda": "cuda:0"}.get(name, name)
    if alias not in present:
        raise DeviceError(f"device '{name}' does not exist here; choose auto, {', '.join(present)}")
    if alias != "cpu" and _started_in != os.getpid():
        raise DeviceError(f"a forked process cannot use {alias}: choose cpu, or start the process by 'spawn'")
    return Device(alias=alias, name=wp.get_device(alias).name if alias != "cpu" else _cpu_name())


def resolve_devices(names: str) -> list[Device]:
    """Turn ``all`` (every GPU, else the CPU) or several names, separated by commas, into devices that exist.

    Raises:
        DeviceError: see :func:`resolve_device`.
    """
    start()
    gpus = [f"cuda:{i}" for i in range(wp.get_cuda_device_count())]
    return [resolve_device(name) for name in ((gpus or ["cpu"]) if names == "all" else names.split(","))]


def _cpu_name() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            model = next(line.split(":", 1)[1].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        model = "CPU"
    return f"{model} ({cores()} cores)"

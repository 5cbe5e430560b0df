"""Compiles (or loads from the kernel cache) the kernels of a job, before the clock of its stages starts."""

import importlib
import pkgutil
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import partial
from inspect import signature
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest import mock

import warp as wp

import lgrasp
from lgrasp.runtime.cores import cores
from lgrasp.runtime.kernel_cache import is_compiled, note_checksums, usable_folder


def import_all() -> None:
    """Import every module of lgrasp, so that :func:`kernel_modules` sees them; the judge needs a package of its own."""
    for found in pkgutil.walk_packages(lgrasp.__path__, "lgrasp."):
        if not found.name.startswith(("lgrasp._data", "lgrasp.judge")):
            importlib.import_module(found.name)


def kernel_modules(*prefixes: str) -> list[str]:
    """Names of the imported modules below any of ``prefixes`` (default: all of lgrasp) that hold kernels, sorted."""
    return sorted(
        name
        for name, module in list(sys.modules.items())
        if name.startswith(prefixes or "lgrasp.") and any(kernel.func.__module__ == name for kernel in _kernels(module))
    )


def _kernels(module: ModuleType) -> Iterator[wp.Kernel]:
    """Kernels among the values of a module, or in a table of variants of one."""
    for value in list(vars(module).values()):
        for x in value.values() if isinstance(value, dict) else (value,):
            if isinstance(x, wp.Kernel):
                yield x


def first_time(device: str, modules: list[str]) -> str:
    """What a user is told before most of some modules are compiled for a kind of device; "" if they are there."""
    folder, cuda = Path(wp.config.kernel_cache_dir), device != "cpu"
    # the names hold a hash of the code and of the threads of a block: on a CPU one
    names = [wp.get_module(name).get_module_identifier(None if cuda else 1) for name in modules]
    if 2 * sum(is_compiled(folder / name, cuda=cuda) for name in names) >= len(names):
        return ""
    return "compiling kernels once for this machine (up to 60 s on two cores)"


PREPARING = [
    f"lgrasp.{name}" for name in ("field.kernels", "hand.arrays", "hand.distance", "hand.pairs", "object.kernels")
]
"""Modules whose kernels make hands, objects and fields, on the CPU."""


def load_kernels(
    device: str,
    modules: list[str],
    progress: Callable[[str, float], None] | None = None,
    *,
    preparing: bool = False,
) -> None:
    """Compile and load modules, several at a time; elsewhere than so far if the disk has become full.

    Args:
        device: for which: ``cpu`` or ``cuda:N``.
        progress: called with (module that is ready, share done).
        preparing: also :data:`PREPARING` for the CPU, beside the others.
    """
    devices: dict[str, list[str]] = {}
    for name in PREPARING if preparing else ():
        importlib.import_module(name)
        devices[name] = ["cpu"]
    for name in modules:
        devices.setdefault(name, []).append(device)

    def load(name: str) -> None:
        for each in devices[name]:  # one after the other: Warp has no lock for a module
            wp.load_module(name, each)

    wp.synchronize_device(device)  # opens it: two threads at a time would each give it a stream
    folder = usable_folder(Path(wp.config.kernel_cache_dir))
    wp.config.kernel_cache_dir = str(folder)
    with ThreadPoolExecutor(min(cores(), 8)) as pool:
        waiting = {pool.submit(load, name): name for name in devices}
        for done, future in enumerate(as_completed(waiting), 1):
            future.result()
            note_checksums(folder)
            if progress:
                progress(f"kernels {waiting[future]}", done / len(waiting))


_noting = threading.Lock()  # what replaces Warp's functions is there once at a time


def load_launched(call: Callable[[], object], device: str) -> None:
    """Compile and load, several at a time, the modules of the kernels that a call of a library launches; nothing runs.

    Args:
        call: launches on ``device``; what it does may not depend on what kernels find.
    """
    found: dict[wp.Module, set[int | None]] = {}
    caller = threading.get_ident()

    def instead(real: Callable[..., Any], result: Any = None) -> Callable[..., Any]:
        def note(kernel: wp.Kernel, *args: Any, **options: Any) -> Any:
            if threading.get_ident() != caller or kernel.is_generic:
                return real(kernel, *args, **options)
            found.setdefault(kernel.module, set()).add(options.get("block_dim"))
            return result

        return note

    def every_way(real: Callable[..., Any], *args: Any, **options: Any) -> Any:
        if threading.get_ident() != caller:
            return real(*args, **options)
        told = signature(real).bind(*args, **options).arguments
        for name in ("on_true", "on_false", "while_body"):
            if callable(body := told.get(name)):
                body(**told.get("kwargs", {}))
        return None

    with _noting:
        noted: dict[str, Any] = {name: instead(getattr(wp, name)) for name in ("launch", "launch_tiled")}
        noted["get_suggested_block_size"] = instead(wp.get_suggested_block_size, (256, 1))
        noted |= {name: partial(every_way, getattr(wp, name)) for name in ("capture_while", "capture_if")}
        with mock.patch.multiple(wp, **noted):
            call()

    def load(module: wp.Module) -> None:
        for threads in found[module]:
            wp.load_module(module, device, block_dim=threads)

    with ThreadPoolExecutor(min(cores(), 8)) as pool:
        list(pool.map(load, sorted(found, key=lambda module: -len(module.kernels))))

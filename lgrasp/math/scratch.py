"""Memory that the lanes of a worker share, declared once: arrays of one worker, and of many in which each has a row."""

import linecache
from collections.abc import Mapping
from typing import Any

import warp as wp

from lgrasp.math.lanes import lanes_of
from lgrasp.runtime.structs import make_struct


def rows_of(one: Any) -> tuple[Any, Any]:
    """The memory of W workers, and the function of kernels that gives a lane its worker's.

    Args:
        one: Warp struct of one worker: ``lane``, ``lanes`` and arrays (n,).

    Returns:
        Warp struct with ``lanes`` and the same arrays, (W, n) each; and ``scratch_of(every, worker, lane)``.
    """
    arrays = {name: var.type.dtype for name, var in one.vars.items() if isinstance(var.type, wp.array)}
    name, module = f"Every{one.cls.__name__}", one.cls.__module__
    types = {"lanes": wp.int32} | {array: wp.array2d(dtype=dtype) for array, dtype in arrays.items()}
    many = wp.struct(type(name, (), {"__module__": module, "__qualname__": name, "__annotations__": types}))
    lines = [
        "def scratch_of(every: Many, worker: wp.int32, lane: wp.int32):",
        "w = One()",
        "w.lane = lane",
        "w.lanes = every.lanes",
        *(f"w.{array} = every.{array}[worker]" for array in arrays),
        "return w",
    ]
    text, file = "\n    ".join(lines), f"<scratch_of of {module}>"
    linecache.cache[file] = len(text), None, text.splitlines(keepends=True), file  # where Warp reads a function's text
    made: dict[str, Any] = {"__name__": module, "One": one, "Many": many, "wp": wp}
    exec(compile(text, file, "exec"), made)
    return many, wp.func(made["scratch_of"])


def empty_rows(many: Any, workers: int, sizes: Mapping[str, int], device: str) -> Any:
    """Memory of as many workers as are at work at a time; ``sizes``: n of each array."""
    arrays = {n: wp.empty((workers, size), dtype=many.vars[n].type.dtype, device=device) for n, size in sizes.items()}
    return make_struct(many, lanes=lanes_of(device), **arrays)

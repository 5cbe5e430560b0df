"""Device arrays to the host with one wait, through page-locked memory that is kept.

The only way there: Warp's own ``array.numpy()`` puts another stream in the place of the device's while it copies, for
every thread, so that two at once may leave the device without its own.
"""

import time
from collections.abc import Sequence
from contextlib import nullcontext, suppress

import numpy as np
import warp as wp

from lgrasp.runtime.turn import others_turn

_ALIGNMENT = 256  # bytes that places in the staging memory are rounded up to
_LEAST_STAGING = 1 << 20  # bytes
_CAPTURE_STEP, _LONGEST_CAPTURE = 0.0005, 30.0  # [s]; a graph is captured in some 10 ms
_staging: list[wp.array] = []  # what nobody uses just now


def fetch(arrays: Sequence[wp.array], *, others: bool = False) -> list[np.ndarray]:
    """Copies of contiguous arrays of one device as NumPy arrays of their own.

    Args:
        arrays: shape (N, …) each; vector and transform types add a dimension, as ``numpy()`` does.
        others: may launch while this thread waits (:func:`~lgrasp.runtime.turn.others_turn`); not where it holds a lock
            that they may need.
    """
    waiting = others_turn if others else nullcontext
    if not arrays or not arrays[0].device.is_cuda:
        copies = [a.numpy().copy() for a in arrays]
        with waiting():
            return copies
    places = np.cumsum(
        [0, *(-(-a.size * wp.types.type_size_in_bytes(a.dtype) // _ALIGNMENT) * _ALIGNMENT for a in arrays)]
    )
    device, memory = arrays[0].device, _take_staging(int(places[-1]))
    out = []
    for a, place in zip(arrays, places, strict=False):
        host = wp.array(ptr=memory.ptr + int(place), dtype=a.dtype, shape=a.shape, device="cpu", copy=False)
        if a.size:
            wp.copy(host, a, stream=device.stream)
        out.append(host)
    copied = device.stream.record_event(wp.Event(device))
    with waiting():
        wait_for(copied)
        copies = [host.numpy().copy() for host in out]
    _staging.append(memory)
    return copies


def wait_for(event: wp.Event) -> None:
    """Until an event has come; Warp refuses to wait while another thread captures a graph."""
    end = time.monotonic() + _LONGEST_CAPTURE
    while True:
        try:
            wp.synchronize_event(event)
            return
        except RuntimeError as error:
            if "graph capture" not in str(error) or time.monotonic() > end:
                raise
        time.sleep(_CAPTURE_STEP)


def _take_staging(size: int) -> wp.array:
    """Page-locked memory of ``size`` bytes at least, which nobody else uses."""
    memory = None
    with suppress(IndexError):  # not asked before: another thread may take the last in between
        memory = _staging.pop()
    if memory is None or memory.shape[0] < size:
        memory = wp.empty(max(2 * size, _LEAST_STAGING), dtype=wp.uint8, device="cpu", pinned=True)
    return memory


def to_numpy(array: wp.array) -> np.ndarray:
    """A copy of one array (:func:`fetch`)."""
    return fetch([array])[0]

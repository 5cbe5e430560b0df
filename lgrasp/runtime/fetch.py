"""Device arrays to the host with one wait, through page-locked memory that is kept.

The only way there: Warp's own ``array.numpy()`` puts another stream in the place of the device's while it copies, for
every thread, so that two at once may leave the device without its own.
"""

import threading
from collections.abc import Sequence

import numpy as np
import warp as wp

_ALIGNMENT = 256  # bytes that places in the staging memory are rounded up to
_staging: dict[str, wp.array] = {}  # by device
_lock = threading.Lock()


def fetch(arrays: Sequence[wp.array]) -> list[np.ndarray]:
    """Copies of contiguous arrays of one device as NumPy arrays of their own.

    Args:
        arrays: shape (N, …) each; vector and transform types add a dimension, as ``numpy()`` does.
    """
    if not arrays or not arrays[0].device.is_cuda:
        return [a.numpy().copy() for a in arrays]
    places = np.cumsum(
        [0, *(-(-a.size * wp.types.type_size_in_bytes(a.dtype) // _ALIGNMENT) * _ALIGNMENT for a in arrays)]
    )
    device = arrays[0].device
    with _lock:
        memory = _staging.get(device.alias)
        if memory is None or memory.shape[0] < places[-1]:
            memory = wp.empty(max(2 * int(places[-1]), 1 << 20), dtype=wp.uint8, device="cpu", pinned=True)
            _staging[device.alias] = memory
        out = []
        for a, place in zip(arrays, places, strict=False):
            host = wp.array(ptr=memory.ptr + int(place), dtype=a.dtype, shape=a.shape, device="cpu", copy=False)
            if a.size:
                wp.copy(host, a, stream=device.stream)
            out.append(host)
        wp.synchronize_stream(device.stream)
        return [host.numpy().copy() for host in out]


def to_numpy(array: wp.array) -> np.ndarray:
    """A copy of one array (:func:`fetch`)."""
    return fetch([array])[0]

"""Running sums on a device, in the order of its stream whatever thread asks."""

import warp as wp


def running_sums(values: wp.array) -> None:
    """Replace each number (N,) i32 by the sum of all up to it."""
    with values.device.context_guard:  # the library scans in the stream of the thread's current context
        wp.utils.array_scan(values, values, inclusive=True)

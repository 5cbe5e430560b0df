"""Whether there is a driver of GPUs, found out without Warp."""

import ctypes
import os

from lgrasp.errors import DeviceError


def has_driver() -> bool:
    """Whether a CUDA driver can be loaded."""
    try:
        ctypes.CDLL("nvcuda.dll" if os.name == "nt" else "libcuda.so.1")
    except OSError:
        return False
    return True


def check_driver(name: str | None) -> None:
    """Refuse a GPU where there is no driver.

    Args:
        name: of a device; None: none is asked for.

    Raises:
        DeviceError: it is a GPU's, and no GPU can be used here.
    """
    if name and name.startswith("cuda") and not has_driver():
        raise DeviceError(f"device '{name}' does not exist here; choose auto, cpu")

"""Warp functions shared by kernels, and the choice of device."""

from lgrasp.device.runtime import Device, resolve_device

__all__ = ["Device", "resolve_device"]
